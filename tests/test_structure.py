"""The project's folders: short enough to be read, and all of them packaged."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("app", "drivers", "segmentation")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def test_every_folder_is_packaged():
    with (ROOT / "pyproject.toml").open("rb") as file:
        listed = tomllib.load(file)["tool"]["setuptools"]["packages"]
    folders = {".".join(("nurbseg", *path.parent.relative_to(ROOT).parts)) for path in FILES}
    assert folders <= set(listed)


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=str)
def test_a_folder_can_be_read(folder: Path):
    assert len([path for path in FILES if path.parent == folder]) <= 14
