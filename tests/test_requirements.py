"""The pinned versions that make installs: all that the project asks for, each with its hashes."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
_PINNED = re.compile(r"([\w.-]+)==(\S+?)( ; [^\\]+)? \\")
_HASH = re.compile(r"    --hash=sha256:[0-9a-f]{64}( \\)?")


def wanted(extras: tuple[str, ...]) -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = list(project["dependencies"])
    for extra in extras:
        texts += [each for each in project["optional-dependencies"][extra] if "nurbseg[" not in each]
    return [Requirement(text) for text in texts]


def pinned(path: Path) -> dict[str, str]:
    """Names and versions; fails on a line that is neither a pinned version nor a hash of one."""
    versions: dict[str, str] = {}
    for line in path.read_text().splitlines():
        found = _PINNED.fullmatch(line)
        if found is not None:
            versions[canonicalize_name(found[1])] = found[2]
        else:
            assert _HASH.fullmatch(line), line
    return versions


@pytest.mark.parametrize(
    ("name", "extras"),
    [("run", ()), ("dev", ("eval", "realsense", "dev")), ("docs", ("docs",))],
)
def test_all_that_the_project_asks_for_is_pinned_with_hashes(name: str, extras: tuple[str, ...]) -> None:
    versions = pinned(ROOT / "requirements" / f"{name}.txt")
    for requirement in wanted(extras):
        assert requirement.specifier.contains(versions[canonicalize_name(requirement.name)]), requirement


def test_what_runs_and_what_makes_the_site_have_the_versions_that_are_tested() -> None:
    tested = pinned(ROOT / "requirements" / "dev.txt")
    assert pinned(ROOT / "requirements" / "run.txt").items() <= tested.items()
    site = pinned(ROOT / "requirements" / "docs.txt")
    assert pinned(ROOT / "requirements" / "run.txt").items() <= site.items()
    assert {name: site[name] for name in site if name in tested}.items() <= tested.items()


def test_what_builds_is_pinned() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    versions = pinned(ROOT / "requirements" / "build.txt")
    for requirement in map(Requirement, build):
        assert requirement.specifier.contains(versions[canonicalize_name(requirement.name)])
