"""The project's folders: short enough to be read, all of them packaged, and described as they are."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("app", "drivers", "segmentation")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def test_every_folder_is_packaged():
    with (ROOT / "pyproject.toml").open("rb") as file:
        setuptools = tomllib.load(file)["tool"]["setuptools"]
    named = {folder: package for package, folder in setuptools["package-dir"].items()}
    folders = {path.parent.relative_to(ROOT) for path in FILES}
    packages = {named.get(str(folder), ".".join(("nurbseg", *folder.parts))) for folder in folders}
    assert packages <= set(setuptools["packages"])


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=str)
def test_a_folder_can_be_read(folder: Path):
    assert len([path for path in FILES if path.parent == folder]) <= 14


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_files_that_a_page_names_exist(page: Path):
    text = page.read_text()
    named = set(re.findall(r"`((?:app|drivers|segmentation|tests|benchmarks)/[\w./]*)`", text))
    assert not {name for name in named if not (ROOT / name).exists()}
