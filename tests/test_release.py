"""What is released is checked: clean tree, section of the changelog, whole archives of one version."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hatchling")
ROOT = Path(__file__).parent.parent
_NAMES = ("src", "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md")


@pytest.fixture(scope="module")
def release() -> Any:
    spec = importlib.util.spec_from_file_location("release", ROOT / ".ci" / "release.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def git(folder: Path, *words: str) -> None:
    subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=folder, check=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "2.0"\n')
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## [2.0] - 2030-01-31\n\n## [1.0] - 2029-01-31\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "all")
    return tmp_path


def test_a_clean_tree_with_a_section_for_its_version_is_ready(release: Any, checkout: Path) -> None:
    assert release.ready(checkout) == []


@pytest.mark.parametrize("heading", ["## [Unreleased]", "## [2.0]", "## [2.0.1] - 2030-01-31"])
def test_a_changelog_without_a_dated_section_is_not_ready(release: Any, checkout: Path, heading: str) -> None:
    (checkout / "CHANGELOG.md").write_text(f"# Changelog\n\n{heading}\n")
    git(checkout, "commit", "--quiet", "-a", "-m", "other")
    assert release.ready(checkout) == ["CHANGELOG.md: no section '## [2.0] - YYYY-MM-DD'"]


def test_what_is_not_committed_is_named(release: Any, checkout: Path) -> None:
    (checkout / "new.py").touch()
    (checkout / "pyproject.toml").write_text('[project]\nversion = "2.0"\n\n')
    assert release.ready(checkout) == ["not committed: pyproject.toml, new.py"]


def test_the_project_has_a_section_of_its_changelog(release: Any) -> None:
    assert not [each for each in release.ready(ROOT) if each.startswith("CHANGELOG.md")]


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("release")
    for name in _NAMES:
        # The links in src/nurbseg become folders, which is what is built of them.
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, root / name)
    command = [sys.executable, "-m", "hatchling", "build", "--directory", "dist"]
    subprocess.run(command, cwd=root, check=True, timeout=120, capture_output=True)
    return root


@pytest.fixture
def folder(archives: Path, tmp_path: Path) -> Path:
    shutil.copytree(archives / "dist", tmp_path / "dist")
    shutil.copy(archives / "pyproject.toml", tmp_path)
    return tmp_path


def test_the_archives_that_are_built_pass(release: Any, folder: Path) -> None:
    assert release.built(folder) == []


def test_archives_of_another_version_or_too_many_do_not_pass(release: Any, folder: Path) -> None:
    (folder / "dist" / "nurbseg-0.9.tar.gz").touch()
    (problem,) = release.built(folder)
    assert problem.startswith("dist: expected nurbseg-")
    assert "nurbseg-0.9.tar.gz" in problem


@pytest.mark.parametrize(
    ("lacks", "change", "said"),
    [
        ("nurbseg/recordings/demo.mcap", ("", ""), "lacks nurbseg/recordings/demo.mcap"),
        ("", ("\nVersion: ", "\nVersion: 7"), "of version 7"),
        ("", ("\nRequires-Python: ", "\nRequires-Python: about "), "requires-python"),
        ("", ("text/markdown", "text/plain"), "text/plain"),
    ],
)
def test_a_wheel_that_is_not_whole_does_not_pass(
    release: Any, folder: Path, lacks: str, change: tuple[str, str], said: str
) -> None:
    (wheel,) = (folder / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = {name: archive.read(name) for name in archive.namelist() if name != lacks}
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, content in held.items():
            about = name.endswith("/METADATA")
            archive.writestr(name, content.decode().replace(*change) if about and change[0] else content)
    (problem,) = release.built(folder)
    assert said in problem
