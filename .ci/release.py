"""Checks what is released: `ready` before it is built, `built` afterward; exits with 1 if not so."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

from packaging.metadata import Metadata

#: What an archive must hold to be of use.
_WHEEL = (
    "nurbseg/__init__.py",
    "nurbseg/py.typed",
    "nurbseg/recordings/demo.mcap",
    "nurbseg/app/commands.py",
)
_SOURCE = ("pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", *(f"src/{name}" for name in _WHEEL))


def version(root: Path) -> str:
    """Return the version, which pyproject.toml alone states."""
    return str(tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"])


def ready(root: Path) -> list[str]:
    """Return what keeps a release from being built."""
    problems = []
    status = ["git", "-C", str(root), "status", "--porcelain"]
    if changed := subprocess.run(status, capture_output=True, text=True, check=True).stdout.splitlines():
        problems.append(f"not committed: {', '.join(line[3:] for line in changed)}")
    heading = rf"^## \[{re.escape(version(root))}\] - \d{{4}}-\d\d-\d\d$"
    if not re.search(heading, (root / "CHANGELOG.md").read_text(), re.MULTILINE):
        problems.append(f"CHANGELOG.md: no section '## [{version(root)}] - YYYY-MM-DD'")
    return problems


def built(root: Path) -> list[str]:
    """Return what is wrong with the archives in dist/."""
    number = version(root)
    wheel, source = f"nurbseg-{number}-py3-none-any.whl", f"nurbseg-{number}.tar.gz"
    found = sorted(path.name for path in (root / "dist").iterdir() if not path.name.startswith("."))
    if found != [wheel, source]:
        return [f"dist: expected {wheel} and {source} only, got {', '.join(found) or 'nothing'}"]
    problems = []
    with zipfile.ZipFile(root / "dist" / wheel) as archive:
        held = {name: archive.read(name) for name in archive.namelist() if name.endswith("/METADATA")}
        problems += [f"{wheel}: lacks {name}" for name in _WHEEL if name not in archive.namelist()]
    with tarfile.open(root / "dist" / source) as archive:
        names = [member.name.partition("/")[2] for member in archive.getmembers()]
        problems += [f"{source}: lacks {name}" for name in _SOURCE if name not in names]
    for name, content in held.items():
        try:
            about = Metadata.from_email(content, validate=True)
        except ExceptionGroup as group:
            problems += [f"{wheel}, {name}: {err}" for err in group.exceptions]
            continue
        if str(about.version) != number or about.description_content_type != "text/markdown":
            problems.append(f"{wheel}, {name}: of version {about.version}, {about.description_content_type}")
    return problems


if __name__ == "__main__":
    found = {"ready": ready, "built": built}[sys.argv[1]](Path(__file__).parent.parent)
    for problem in found:
        print(f"release: {problem}")
    sys.exit(int(bool(found)))
