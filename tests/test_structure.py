"""The project's folders: short enough to be read, all of them packaged, and described as they are."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("app", "common", "drivers", "evaluation", "library", "segmentation")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def test_every_room_is_linked_into_the_package_and_nothing_else_is():
    links = {path.name: path.resolve() for path in (ROOT / "src" / "nurbseg").iterdir() if path.is_symlink()}
    assert links == {name: ROOT / name for name in (*PACKAGES, "recordings")}


def test_every_folder_is_a_package():
    folders = {path.parent for path in FILES} | {ROOT / "recordings"}
    assert not [folder for folder in sorted(folders) if not (folder / "__init__.py").is_file()]


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=str)
def test_a_folder_can_be_read(folder: Path):
    named = [path for path in FILES if path.parent == folder and path.name != "__init__.py"]
    assert len(named) <= 12


def test_no_file_has_a_second_subject():
    command = [sys.executable, ROOT / ".ci" / "file_lengths.py", *FILES]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_files_that_a_page_names_exist(page: Path):
    text = page.read_text()
    named = set(re.findall(r"`((?:app|drivers|evaluation|segmentation|tests|benchmarks)/[\w./]*)`", text))
    assert not {name for name in named if not (ROOT / name).exists()}


def is_number(value: ast.expr) -> bool:
    """Whether an expression is a number, or some, perhaps of single precision."""
    if isinstance(value, ast.Call) and ast.unparse(value.func) == "np.float32":
        value = value.args[0]
    try:
        found = ast.literal_eval(value)
    except ValueError:
        return False
    return all(isinstance(each, int | float) for each in (found if isinstance(found, tuple) else [found]))


@pytest.mark.parametrize("path", sorted((ROOT / "segmentation").rglob("*.py")), ids=lambda path: path.stem)
def test_a_number_that_is_no_setting_says_what_it_is(path: Path):
    lines = path.read_text().splitlines()
    said: set[int] = set()
    for node in ast.parse(path.read_text()).body:
        before = node.lineno - 2
        if isinstance(node, ast.Assign) and is_number(node.value):
            # One comment may be for several that stand together.
            assert lines[before].startswith("#:") or before in said, f"{path}: {lines[node.lineno - 1]}"
            said.add(node.end_lineno - 1)
