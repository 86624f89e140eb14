"""Imports point one way: from evaluation to app, to library, to segmentation and drivers, to common."""

import ast
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import exported_names
import pytest
from child_python import run_python
from recorded_scene import write_pairs
from rendered import rendered

from nurbseg.drivers import open_source

ROOT = Path(__file__).parent.parent
ALLOWED = {
    "evaluation": ("app", "library", "segmentation", "drivers", "common"),
    "app": ("library", "segmentation", "drivers", "common"),
    "library": ("segmentation", "common"),
    "segmentation": ("common",),
    "drivers": ("common",),
    "common": (),
}


def imported(path: Path) -> set[str]:
    """The project's modules that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            folder = ROOT.joinpath(*node.module.split(".")[1:])
            names |= set(whole) if folder.is_dir() else {node.module}
    return {name for name in names if name.split(".")[0] == "nurbseg"}


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_point_one_way(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in files
        for name in imported(path)
        if name.split(".")[1] not in (package, *ALLOWED[package])
    ]
    assert not wrong, "\n".join(wrong)


def importers() -> dict[str, set[str]]:
    """What each module of the project imports."""
    found = {
        "nurbseg." + ".".join(path.relative_to(ROOT).with_suffix("").parts): imported(path)
        for package in ALLOWED
        for path in (ROOT / package).rglob("*.py")
        # A package names its modules for who looks for them there; its modules do not import it.
        if path.name != "__init__.py"
    }
    assert len(found) > 100
    return found


def test_no_two_modules_import_each_other() -> None:
    # Also not for their types alone, nor within a function: a circle is one thing in two files.
    TopologicalSorter(importers()).prepare()


def test_nothing_in_a_folder_imports_each_other() -> None:
    # In each folder its files and the folders in it, with all that is in those.
    entries: dict[str, set[str]] = {}
    for module, names in importers().items():
        for name in names:
            parts, others = module.split("."), name.split(".")
            same = next((n for n, (a, b) in enumerate(zip(parts, others, strict=False)) if a != b), 0)
            if same:
                entries.setdefault(".".join(parts[: same + 1]), set()).add(".".join(others[: same + 1]))
    assert len(entries) > 100
    TopologicalSorter(entries).prepare()


def test_the_laboratory_needs_neither_the_loop_nor_the_viewer() -> None:
    found = {name for path in (ROOT / "evaluation").rglob("*.py") for name in imported(path)}
    assert not [name for name in found if name.startswith(("nurbseg.app.live", "nurbseg.app.view"))]


@pytest.mark.parametrize(
    "module",
    [
        "nurbseg.drivers",
        "nurbseg.common.errors",
        "nurbseg.drivers.registry",
        "nurbseg.common.settings",
        "nurbseg.segmentation",
        "nurbseg.segmentation.config",
    ],
)
def test_what_the_command_line_needs_for_its_help_imports_no_numpy(module: str) -> None:
    program = f"import sys, {module}; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=60).returncode == 0


def test_the_process_that_shows_and_saves_loads_no_compiler() -> None:
    # It would take half a second of the processor before the first frame is saved.
    program = "import sys, nurbseg.app.view.program; sys.exit(bool({'numba', 'scipy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", program], timeout=60).returncode == 0


_REPLAY = """
import sys

sys.argv[1:] = ["--replay", sys.argv[1], "--view", "none", "--control", "off"]
from nurbseg.app.command.live_command import main

assert main() == 0
loaded = {name: each for name, each in sys.modules.items() if name.startswith("nurbseg.")}
print(*(name for name, each in loaded.items() if not hasattr(each, "__path__")))
"""


@pytest.mark.parametrize("form", ["recording", "folder"])
def test_a_replay_that_shows_nothing_loads_nothing_that_measures_or_draws(tmp_path: Path, form: str) -> None:
    recording = rendered("width=96&height=72&frames=3")
    if form == "folder":
        with open_source(recording) as source:
            recording = str(write_pairs(tmp_path, list(source)))
    # The first run after a change may compile, in processes of its own.
    run_python(_REPLAY, recording)
    loaded = run_python(_REPLAY, recording).stdout.split()
    assert "nurbseg.segmentation.live.tree" in loaded
    unused = (
        *(
            "app.export.exporter",
            "app.publish",
            "app.view.drawing",
            "drivers.openni2",
            "drivers.mcap.container",
        ),
        *("library.boxes", "library.meshing", "library.tracking"),
    )
    prefixes = tuple(f"nurbseg.{name}" for name in unused)
    assert [name for name in loaded if name.startswith(prefixes)] == []
    assert len(loaded) <= 110


def calls(path: Path) -> list[ast.Call]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]


def test_every_program_that_is_started_gets_an_environment_without_the_working_folder() -> None:
    started = [
        (f"{path.relative_to(ROOT)}:{call.lineno}", [word.arg for word in call.keywords])
        for package in ALLOWED
        for path in (ROOT / package).rglob("*.py")
        for call in calls(path)
        if ast.unparse(call.func) in ("subprocess.run", "subprocess.Popen", "Popen", "os.posix_spawn")
    ]
    assert len(started) >= 6
    assert [place for place, words in started if "env" not in words] == []


def test_libraries_that_look_for_settings_in_the_working_folder_are_imported_without_them() -> None:
    wrong = []
    for package in ALLOWED:
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            if re.search(r"(from|import) (numba|matplotlib)", text) and "with ignored_" not in text:
                wrong.append(path.relative_to(ROOT))
    assert not wrong


@pytest.mark.parametrize("package", ["nurbseg.drivers", "nurbseg.segmentation"])
def test_every_exported_name_is_what_it_is_declared_to_be(package: str) -> None:
    done = subprocess.run(
        [sys.executable, exported_names.__file__, package], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


def test_a_name_that_is_not_exported_is_missing() -> None:
    import nurbseg.drivers

    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        nurbseg.drivers.nothing_of_the_kind  # noqa: B018
