"""The wheel and the source distribution: each is built, and installed where nothing else is."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
#: What is no part of the project's source: other people's, and what was made of it.
_LEFT_OUT = (".venv*", "build", "out", "*.egg-info", "__pycache__", ".git", ".hypothesis", ".*_cache")
COMMANDS = ("nurbseg-batch", "nurbseg-devices", "nurbseg-eval", "nurbseg-live", "nurbseg-record")
_BUILD = (
    "import sys; from hatchling import build as backend; "
    "print(getattr(backend, 'build_' + sys.argv[1])(sys.argv[2]))"
)


def build(kind: str, source: Path, output: Path) -> Path:
    output.mkdir(exist_ok=True)
    command = [sys.executable, "-c", _BUILD, kind, str(output)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return output / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = tmp_path_factory.mktemp("source") / "nurbseg"
    # The links in src/nurbseg stay links.
    shutil.copytree(ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(*_LEFT_OUT))
    return copy


def environment_with(folder: Path, *package: str) -> tuple[Path, Path]:
    """Install a package where nothing else is; return the environment's Python and its site-packages."""
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    # Its dependencies are those of the tests, which takes no network; everything else must be in the package.
    site = next((folder / "lib").glob("python*/site-packages"))
    others = [path for path in sys.path if "site-packages" in path]
    (site / "dependencies.pth").write_text("".join(f"{path}\n" for path in others))
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps"]
    subprocess.run([*pip, "--ignore-installed", "--no-index", *package], check=True, timeout=120)
    return python, site


def test_tools_know_the_package_of_an_editable_install_and_its_new_files(
    source: Path, tmp_path: Path
) -> None:
    pytest.importorskip("hatchling")
    copy = tmp_path / "nurbseg"
    shutil.copytree(source, copy, symlinks=True)
    python, _ = environment_with(tmp_path / "env", "--no-build-isolation", "-e", str(copy))
    (copy / "segmentation" / "just_written.py").write_text("ANSWER: int = 42\n")
    script = tmp_path / "script.py"
    script.write_text(
        "import nurbseg\nfrom nurbseg.common.frame import RGBDFrame\n"
        "from nurbseg.segmentation import just_written\n"
        "def answer(frame: RGBDFrame) -> int:\n"
        "    return just_written.ANSWER + len(nurbseg.segment(frame).tree.leaves())\n"
        "print(nurbseg.__path__[0], just_written.ANSWER)\n"
    )
    environment = os.environ | {"PYTHONPATH": ""}
    done = subprocess.run(
        [python, script], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.stdout.split() == [str(copy / "src" / "nurbseg"), "42"], done.stderr
    # Another package of the same name must not be what is found.
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(python), str(script)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout
    done = subprocess.run(
        [python, "-c", "import drivers"], cwd=tmp_path, env=environment, capture_output=True
    )
    assert b"No module named 'drivers'" in done.stderr


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", source, tmp_path_factory.mktemp("dist"))


def test_the_source_distribution_makes_the_same_wheel(wheel: Path, source: Path, tmp_path: Path) -> None:
    archive = build("sdist", source, tmp_path / "dist")
    # Python's own unpacking warns without a filter in 3.12, and has none before 3.11.4.
    (tmp_path / "unpacked").mkdir()
    subprocess.run(["tar", "-xf", archive, "-C", tmp_path / "unpacked"], check=True, timeout=60)
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    again = build("wheel", unpacked, tmp_path / "dist")
    assert again.name == wheel.name
    assert content(again) == content(wheel)


def content(archive: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(archive) as file:
        return {name: file.read(name) for name in file.namelist()}


def test_it_can_be_installed_in_an_empty_environment(wheel: Path, tmp_path: Path) -> None:
    python, site = environment_with(tmp_path / "env", str(wheel))
    for name in COMMANDS:
        done = subprocess.run(
            [tmp_path / "env" / "bin" / name, "--help"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(site)},
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith(f"usage: {name}")
    where = "import nurbseg.app as a; from importlib.resources import files; "
    where += "print(a.__file__); print((files('nurbseg.recordings') / 'demo.mcap').is_file())"
    done = subprocess.run(
        [python, "-c", where],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.split() == [str(site / "nurbseg" / "app" / "__init__.py"), "True"], done.stderr
    # The renderer is not installed.
    recordings = {path.name for path in (site / "nurbseg" / "recordings").iterdir()}
    assert recordings - {"__pycache__"} == {"__init__.py", "demo.mcap"}
