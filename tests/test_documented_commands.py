"""What README and docs tell to type in a shell: run as it stands, or, where that cannot be, looked up."""

from __future__ import annotations

import functools
import gc
import logging
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import chdir
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

import cv2
import pytest
from rendered import rendered

from nurbseg.drivers.registry import open_source

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BIN = Path(sys.executable).parent
_SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
_CAMERA = rendered("width=96&height=72&frames=2")

#: The modules of the commands.
MODULES = {
    "nurbseg-batch": "nurbseg.app.batch.batch_command",
    "nurbseg-devices": "nurbseg.app.devices.devices_command",
    "nurbseg-eval": "nurbseg.evaluation.eval_command",
    "nurbseg-live": "nurbseg.app.command.live_command",
    "nurbseg-record": "nurbseg.app.recording.record_command",
}

Words = list[str]


def added(*words: str) -> Callable[[Words], Words]:
    return lambda before: [*before, *words]


def without(*words: str) -> Callable[[Words], Words]:
    return lambda before: [word for word in before if word not in words]


#: What is run, by how it begins: how it is made short, and the exit codes that it may have.
#: What shows is not shown, replays end after two frames, searches after two trials, studies split little, and
#: a batch starts no processes.
RUN: list[tuple[str, Callable[[Words], Words], tuple[int, ...]]] = [
    (r"nurbseg-devices", added(), (0, 1)),
    (r"nurbseg-live --replay .* --view none", added(), (0,)),
    (r"nurbseg-live --replay .* --explain", added("--splits-max", "4"), (0,)),
    (r"nurbseg-live (--replay|--color|my_)", added("--view", "none", "--speed", "0", "--no-paused"), (0,)),
    (r"nurbseg-live --config", added("--view", "none", "--speed", "0", "--frames", "2"), (0,)),
    (r"nurbseg-live --print-config", added(), (0,)),
    (r"nurbseg-live$", added("--view", "none", "--speed", "0", "--frames", "2"), (0,)),
    (r"nurbseg-batch", added("--workers", "1"), (0,)),
    (r"nurbseg-eval run my_", added("--time-frames", "0", "--set", "splits_max=2"), (0,)),
    (r"nurbseg-eval tune", lambda words: [*words[: words.index("--budget") + 1], "2", "--folds", "2"], (0,)),
    (r"nurbseg-eval (noise|figure|check)", added(), (0,)),
    (r"nurbseg-record check", without("clip.oni"), (0,)),
    (r"nurbseg-record (repair|info|cut|convert|extract)", added(), (0,)),
]
#: What cannot be run here: it needs a camera, data of others, hours, or changes the computer.
LOOKED_UP = (
    r"nurbseg-live --device",
    r"nurbseg-eval run (mosd_learn|seed)",
    r"\.venv/bin/python (benchmarks|docs|recordings)/",
)
#: What is no command of the project's; targets of make are looked up in the Makefile.
OTHERS = (r"make \w+$", r"pip install", r"python3 -m venv", r"\.venv/bin/(pip|pre-commit) install")


def commands(page: Path) -> list[str]:
    """Commands of a page, continued lines joined, comments left out."""
    text = "\n".join(_SHELL.findall(page.read_text())).replace("\\\n", " ")
    lines = (shlex.join(shlex.split(line, comments=True)) for line in text.splitlines())
    return [line for line in lines if line]


@functools.cache
def help_of(*command: str) -> str:
    flag = "--help-all" if Path(command[0]).name == "nurbseg-live" else "--help"
    done = subprocess.run([*command, flag], capture_output=True, text=True, timeout=120, check=True)
    return done.stdout


def write_images(folder: Path, color: str, depth: str, label: str = "") -> None:
    """Write two rendered frames as images whose names are patterns of their number."""
    folder.mkdir()
    with open_source(_CAMERA) as source:
        for frame in source:
            images = {color: frame.color[..., ::-1], depth: frame.depth_mm}
            if label:
                assert frame.labels is not None
                images[label] = frame.labels
            for name, image in images.items():
                # Of the size of the camera that the pages state.
                image = cv2.resize(image, (640, 480), interpolation=cv2.INTER_NEAREST)
                cv2.imwrite(str(folder / name.format(frame.index)), image)


def run(command: Words, folder: Path, codes: tuple[int, ...] = (0,)) -> None:
    """Run a command in this process, which has loaded what it needs."""
    main = import_module(MODULES[command[0]]).main
    # Commands replace the handlers of the log.
    with chdir(folder), patch.object(logging.getLogger(), "handlers", []):
        try:
            code = main(command[1:])
        except SystemExit as end:
            code = end.code or 0
        finally:
            logging.captureWarnings(False)
            gc.unfreeze()
    assert code in codes, shlex.join(command)


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the pages' commands are given."""
    folder = tmp_path_factory.mktemp("commands")
    names = ("s{}_color.png", "s{}_depth.png", "s{}_label.png")
    write_images(folder / "my_folder", *names[:2])
    write_images(folder / "my_labeled_folder", *names)
    write_images(folder / "my_frames", *names)
    camera = "registered = true\n[color]\nwidth = 640\nheight = 480\n"
    camera += "fx = 525.0\nfy = 525.0\ncx = 319.5\ncy = 239.5\n"
    (folder / "my_frames" / "camera.toml").write_text(camera)
    write_images(folder / "shots", "IMG_{}.jpg", "range-{:03}.png")
    (folder / "recordings").mkdir()
    quiet = ["nurbseg-live", "--quiet", "--speed", "0", "--view", "none"]
    run([*quiet, "--replay", _CAMERA, "--record", "kitchen.mcap", "--save", "run.rrd"], folder)
    for copy in ("wall.mcap", "recordings/a.mcap", "recordings/b.mcap"):
        shutil.copyfile(folder / "kitchen.mcap", folder / copy)
    intrinsics = ["--intrinsics", "525,525,319.5,239.5"]
    run([*quiet, "--replay", "my_folder", *intrinsics, "--export", "DIR", "--export-surfaces"], folder)
    return folder


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_of_a_page_do_what_they_shall(page: Path, everything: Path, tmp_path: Path) -> None:
    folder = tmp_path / "here"
    shutil.copytree(everything, folder)
    if page.name == "evaluation.md":
        words = ["--speed", "0", "--view", "none", "--export", "out", "--export-surfaces"]
        run(["nurbseg-live", "--replay", "my_frames", *words], folder)
    for command in commands(page):
        rule = next(((made, codes) for start, made, codes in RUN if re.match(start, command)), None)
        if rule is not None:
            words = [each for word in shlex.split(command) for each in matching(word, folder)]
            run(rule[0](words), folder, rule[1])
        elif any(re.match(start, command.replace("'", "")) for start in LOOKED_UP):
            look_up(shlex.split(command))
        else:
            assert any(re.match(start, command) for start in OTHERS), f"{page.name}: not known: {command}"
            if command.startswith("make "):
                assert f"\n{command.removeprefix('make ')}:" in (ROOT / "Makefile").read_text()


def matching(word: str, folder: Path) -> Words:
    """What a shell makes of a word: the project's commands take patterns themselves, in quotes."""
    if "*" in word and not word.startswith("shots/"):
        return sorted(str(path.relative_to(folder)) for path in folder.glob(word))
    return [word]


def look_up(words: Words) -> None:
    """Fail on a flag that the command's help does not tell."""
    if words[0].endswith("python"):
        told = help_of(sys.executable, str(ROOT / words[1]))
    else:
        told = help_of(*(str(BIN / words[0]), *words[1 : 2 if words[0] == "nurbseg-eval" else 1]))
    unknown = [word for word in words if word.startswith("--") and not re.search(rf"{word}(?![\w-])", told)]
    assert not unknown, f"{shlex.join(words)}: {unknown}"


def test_the_pages_have_commands_of_every_program() -> None:
    begun = {command.split()[0] for page in PAGES for command in commands(page)}
    assert begun >= {
        "make",
        "nurbseg-batch",
        "nurbseg-devices",
        "nurbseg-eval",
        "nurbseg-live",
        "nurbseg-record",
    }


def test_no_picture_is_drawn_of_a_recording_that_is_not_there(tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    words = [sys.executable, str(ROOT / "docs/render_viewer.py"), "missing.rrd", str(picture)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (2, "render_viewer.py: error: missing.rrd: no such file\n")
    assert not picture.exists()
