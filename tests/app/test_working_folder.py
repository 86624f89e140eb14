"""That no command runs Python code that lies in the folder it is called in."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from rendered import rendered
from virtual_camera import VirtualCameras, openni2_redist, virtual_cameras

__all__ = ["openni2_redist", "virtual_cameras"]

FAST = ["--view", "none", "--splits-max", "1", "--decimation", "8"]

_MODULE = """\
import os, sys
with open({said!r}, "a") as file:
    file.write(" ".join([{name!r}, *sys.orig_argv]) + "\\n")
os._exit(3)
"""


#: Libraries that Python's programs and Rerun's load; what is no library ends a program that finds it.
_LIBRARIES = ("libc.so.6", "libm.so.6", "libz.so.1", "libgcc_s.so.1", "libstdc++.so.6")
#: Settings that libraries look for in the working folder, such that they end who reads them.
_SETTINGS = {".numba_config.yaml": b"- [", "matplotlibrc": b"backend: \xff"}


def _own_environment() -> dict[str, str]:
    """The environment as it was before this process imported OpenCV."""
    return {name: value for name, value in os.environ.items() if name != "LD_LIBRARY_PATH"}


class StrangersFolder:
    """A folder with what programs take for their own from where they are called.

    It holds a module for each one of Python's own, which tells that it was run, and libraries and settings
    that end who reads them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.said = path / "said"
        for name in sys.stdlib_module_names:
            (path / f"{name}.py").write_text(_MODULE.format(said=str(self.said), name=name))
        for name in _LIBRARIES:
            (path / name).write_text("no library")
        for name, content in _SETTINGS.items():
            (path / name).write_bytes(content)

    def run(self, command: str, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run an installed command in it."""
        return subprocess.run(
            [Path(sys.executable).with_name(command), *words],
            cwd=self.path,
            env=_own_environment() | environment,
            capture_output=True,
            text=True,
            timeout=240,
        )

    def code_that_ran(self) -> list[str]:
        """Return the names of the modules that ran, with the command lines of their programs."""
        return self.said.read_text().splitlines() if self.said.exists() else []


@pytest.fixture
def strangers_folder(tmp_path: Path) -> StrangersFolder:
    folder = tmp_path / "stranger"
    folder.mkdir()
    return StrangersFolder(folder)


def test_the_folder_would_be_found_out(strangers_folder: StrangersFolder) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "json.tool"], cwd=strangers_folder.path, env=_own_environment(), timeout=60
    )
    assert done.returncode == 3
    assert strangers_folder.code_that_ran()
    for library in (
        "numba",
        "matplotlib",
        "cv2, subprocess, sys; subprocess.check_call([sys.executable, '-V'])",
    ):
        done = subprocess.run(
            [sys.executable, "-P", "-c", f"import {library}"],
            cwd=strangers_folder.path,
            env=_own_environment(),
            capture_output=True,
            timeout=60,
        )
        assert done.returncode != 0, library


@pytest.mark.parametrize("environment", [{}, {"PYTHONPATH": ""}])
def test_a_camera_and_its_recording_are_read_without_it(
    strangers_folder: StrangersFolder,
    virtual_cameras: VirtualCameras,
    tmp_path: Path,
    environment: dict[str, str],
) -> None:
    virtual_cameras.add()
    recording = str(tmp_path / "X.mcap")
    words = ["--device", "any", "--frames", "5", "--record", recording, *FAST]
    done = strangers_folder.run("nurbseg-live", *words, **environment)
    assert strangers_folder.code_that_ran() == []
    assert done.returncode == 0, done.stderr
    done = strangers_folder.run("nurbseg-live", "--replay", recording, "--speed", "0", *FAST, **environment)
    assert strangers_folder.code_that_ran() == []
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("words", [["list"], ["doctor"]])
def test_cameras_are_looked_for_without_it(
    strangers_folder: StrangersFolder, virtual_cameras: VirtualCameras, words: list[str]
) -> None:
    virtual_cameras.add()
    done = strangers_folder.run("nurbseg-devices", *words)
    assert strangers_folder.code_that_ran() == []
    assert done.returncode == 0, done.stderr


def test_frames_are_shown_and_saved_without_it(strangers_folder: StrangersFolder, tmp_path: Path) -> None:
    saved = tmp_path / "a.rrd"
    words = ["--replay", rendered("width=160&height=120&frames=2"), "--speed", "0", "--save", str(saved)]
    done = strangers_folder.run("nurbseg-live", *words, *FAST)
    assert strangers_folder.code_that_ran() == []
    assert done.returncode == 0, done.stderr
    assert saved.stat().st_size > 0


def test_frames_are_scored_by_several_processes_without_it(
    strangers_folder: StrangersFolder, tmp_path: Path
) -> None:
    scenes = rendered("width=160&height=120&frames=2")
    words = ["--jobs", "2", "--set", "splits_max=1", "--out", str(tmp_path / "out")]
    done = strangers_folder.run("nurbseg-eval", scenes, *words)
    assert strangers_folder.code_that_ran() == []
    assert done.returncode == 0, done.stderr
