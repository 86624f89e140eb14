"""The project's structure: folders that can be read, files with one subject, and no circle of imports."""

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("app", "drivers", "segmentation")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("nurbseg", *parts)).removesuffix(".__init__")


MODULES = {module_of(path): path for path in FILES}


def imported(path: Path) -> set[str]:
    """The project's modules that a file imports, for types and within functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in MODULES else node.module)
    return found & MODULES.keys()


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """What is left when that which imports nothing that is left is taken away, again and again."""
    left = {name: set(targets) & arrows.keys() for name, targets in arrows.items()}
    while ends := [name for name, targets in left.items() if not targets]:
        for name in ends:
            del left[name]
        for targets in left.values():
            targets.difference_update(ends)
    return [[name, *sorted(targets)] for name, targets in sorted(left.items())]


def test_circles_are_found():
    assert not circles({"a": {"b", "c"}, "b": {"c"}, "c": {"elsewhere"}})
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == [["a", "b"], ["b", "c"], ["c", "b"]]


def test_no_module_imports_itself_through_others():
    assert not circles({name: imported(path) - {name} for name, path in MODULES.items()})


def test_every_folder_is_packaged():
    with (ROOT / "pyproject.toml").open("rb") as file:
        listed = tomllib.load(file)["tool"]["setuptools"]["packages"]
    folders = {".".join(("nurbseg", *path.parent.relative_to(ROOT).parts)) for path in FILES}
    assert folders <= set(listed)


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=str)
def test_a_folder_can_be_read(folder: Path):
    assert len([path for path in FILES if path.parent == folder]) <= 14


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_has_one_subject(path: Path):
    assert len(path.read_text().splitlines()) <= 350
