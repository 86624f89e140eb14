"""Sources of other packages: what is wrong with one is an error that names it, and never ends a program."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from packages_installed import install

from nurbseg.drivers import (
    BackendMissingError,
    DeviceLostError,
    DeviceNotFoundError,
    DriverError,
    FrameTimeoutError,
    RecordingFormatError,
    SourceOptions,
    open_source,
)
from nurbseg.drivers.options import DeviceOptions
from nurbseg.testing import SourceContract

GOOD = """
import numpy as np
from nurbseg.drivers import Calibration, EndOfRecordingError, FrameSource, Intrinsics, RGBDFrame

CALIBRATION = Calibration.registered(Intrinsics(8, 6, 10.0, 10.0, 3.5, 2.5))

class Source(FrameSource):
    def __init__(self, rest, options):
        super().__init__()
        self.rest, self.options, self.number = rest, options, 0
        self.calibration = CALIBRATION
        self.metadata = {"device": "of a test"}

    def _read(self, timeout_s):
        if self.number >= 4:
            raise EndOfRecordingError("the end")
        depth = np.full((6, 8), 1000 + self.number, np.uint16)
        color = np.full((6, 8, 3), 50, np.uint8)
        self.number += 1
        return RGBDFrame(self.number - 1, self.number * 10**7, depth, color, CALIBRATION)

    def _close(self):
        pass
"""
LIVE = (
    GOOD
    + """
import time
class Camera(Source):
    live = True
    def _read(self, timeout_s):
        time.sleep(0.005)
        self.number %= 3
        frame = super()._read(timeout_s)
        self.count = getattr(self, "count", -1) + 1
        return RGBDFrame(self.count, self.count * 10**7 + 1, frame.depth_mm, frame.color, CALIBRATION)
"""
)


@pytest.fixture
def plug(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest):
    def plug(code: str, entries: str = "mine = {name}:Source", name: str = "") -> str:
        name = name or f"package_{abs(hash((request.node.name, code)))}"
        entries = f"[nurbseg.sources]\n{entries.format(name=name)}\n"
        folder = str(install(tmp_path / name, name, code, entries))
        monkeypatch.syspath_prepend(folder)
        # For the source process.
        monkeypatch.setenv("PYTHONPATH", f"{folder}:{os.environ.get('PYTHONPATH', '')}")
        return name

    yield plug
    for name in [module for module in sys.modules if module.startswith("package_")]:
        del sys.modules[name]


class TestRecordingOfAnotherPackage(SourceContract):
    frames = 4

    @pytest.fixture(autouse=True)
    def installed(self, plug) -> None:
        plug(GOOD)

    def open(self):
        return open_source("mine:somewhere")


class TestCameraOfAnotherPackage(SourceContract):
    @pytest.fixture(autouse=True)
    def installed(self, plug) -> None:
        plug(LIVE, "mine = {name}:Camera")

    def open(self):
        return open_source("mine:")


def test_it_is_given_the_rest_of_the_uri_and_the_options(plug):
    opener = "def open_it(rest, options):\n    source = Source(rest, options)\n"
    opener += "    source.metadata['given'] = f'{rest} {options}'\n    return source\n"
    plug(f"{GOOD}\n{opener}", "mine = {name}:open_it")
    options = SourceOptions(depth_scale=500.0)
    with open_source("mine:a:b", options) as source:
        assert source.metadata == {"device": "of a test", "given": f"a:b {options}"}


def test_a_file_and_a_scheme_of_ours_come_first(plug, tmp_path, monkeypatch):
    plug(GOOD, "mine = {name}:Source\nimages = {name}:Source")
    with pytest.raises(RecordingFormatError, match="expected images:"):
        open_source("images:?")
    monkeypatch.chdir(tmp_path)
    Path("mine:file").write_bytes(b"")
    with pytest.raises(RecordingFormatError, match="the file is empty"):
        open_source("mine:file")
    with pytest.raises(DeviceNotFoundError, match=r"nothing:: no such file .* or images: or mine:"):
        open_source("nothing:")


BROKEN = {
    "import": ("import not_there", BackendMissingError, "cannot be imported (ModuleNotFoundError: No module"),
    "syntax": ("def", DriverError, "cannot be opened (SyntaxError"),
    "exit": ("raise SystemExit('bye')", DriverError, "cannot be opened (SystemExit: bye)"),
    "lines": ("raise ValueError('a\\nb' + 'c' * 900)", DriverError, "(ValueError: a bccc"),
    "attribute": ("pass", DriverError, "cannot be opened (AttributeError"),
    "number": ("Source = 5", DriverError, "cannot be opened (TypeError: 'int' object is not callable"),
    "arguments": ("def Source(): pass", DriverError, "cannot be opened (TypeError"),
    "nothing": (
        "def Source(rest, options): pass",
        DriverError,
        "returned NoneType in place of a FrameSource",
    ),
    "failing": ("def Source(rest, options): 1 / 0", DriverError, "cannot be opened (ZeroDivisionError"),
    "super": (GOOD.replace("super().__init__()", "pass"), DriverError, "cannot be opened (AttributeError"),
    "calibration": (
        GOOD.replace("self.calibration = CALIBRATION", "self.calibration = None"),
        DriverError,
        "calibration: is NoneType",
    ),
    "read": (
        GOOD.replace("if self.number", "raise KeyError('lost')\n        if self.number"),
        RecordingFormatError,
        "failed (KeyError: 'lost')",
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_package_is_named_in_one_line(plug, what):
    code, kind, text = BROKEN[what]
    name = plug(code)
    with pytest.raises(kind) as caught, open_source("mine:") as source:
        source.read()
    message = str(caught.value)
    assert text in message
    assert message.startswith(f"mine (package {name} 1.5): ")
    assert "\n" not in message and len(message) < 400


OWN = GOOD.replace(
    "depth = np.full((6, 8), 1000 + self.number, np.uint16)",
    """
        np.save(self.rest, np.full((6, 8), 1000 + self.number, np.uint16))
        depth = np.load(self.rest, mmap_mode="r")""",
).replace('"of a test"}', '"x" * 300_000, "number": 5}')
OWN += """
from nurbseg.drivers import RecordingFormatError
class Own(RecordingFormatError):
    def __init__(self, file, line):
        super().__init__(f"{file}: line {line}")

class Failing(Source):
    def _read(self, timeout_s):
        raise Own("a.txt", 3)
"""


def test_what_is_a_packages_own_gets_through(plug, tmp_path):
    plug(OWN, "mine = {name}:Source\nfailing = {name}:Failing")
    with open_source(f"mine:{tmp_path / 'depth.npy'}") as source:
        assert source.metadata == {"device": "x" * 300_000, "number": "5"}
        assert [frame.depth_mm[0, 0] for frame in source] == [1000, 1001, 1002, 1003]
    with open_source(f"failing:{tmp_path}") as source, pytest.raises(RecordingFormatError) as caught:
        source.read()
    assert (type(caught.value), str(caught.value)) == (RecordingFormatError, "a.txt: line 3")


def test_one_that_states_nothing_is_opened(plug):
    plug(GOOD.replace('{"device": "of a test"}', "{}"))
    with open_source("mine:") as source:
        assert source.metadata == {}
        assert len(list(source)) == 4


def test_what_is_no_frame_is_a_damaged_one(plug, caplog):
    name = plug(GOOD.replace("return RGBDFrame(", "return ("))
    with open_source("mine:") as source:
        assert list(source) == []
        assert source.status.damaged == 4
    assert f"skipped a damaged frame: mine (package {name} 1.5): returned tuple" in caplog.text


def test_a_scheme_of_two_packages_names_both(plug):
    plug(GOOD, name="package_one")
    plug(GOOD, name="package_two")
    with pytest.raises(DriverError, match=r"mine: is registered by package_one 1\.5, package_two 1\.5; un"):
        open_source("mine:")


def test_metadata_of_a_package_that_cannot_be_read_are_an_error(plug):
    plug(GOOD, "no equals sign")
    with pytest.raises(DriverError, match="the installed packages cannot be listed"):
        open_source("mine:")


def test_a_camera_that_fails_is_waited_for_unless_told_otherwise(plug, caplog):
    code = LIVE.replace("self.number %= 3", "import os\n        os.stat(self.rest)\n        self.number %= 3")
    plug(code, "mine = {name}:Camera")
    here = "/nowhere"
    options = SourceOptions(device=DeviceOptions(reconnect=False))
    with open_source(f"mine:{here}", options) as source, pytest.raises(DeviceLostError, match="failed"):
        source.read(5.0)
    with open_source(f"mine:{here}") as source, pytest.raises(FrameTimeoutError):
        source.read(0.5)
    assert "waiting for it to come back" in caplog.text


def test_a_camera_that_never_answers_costs_no_more_than_the_wait(plug):
    # It is read by a thread of its own.
    plug(LIVE.replace("time.sleep(0.005)", "time.sleep(3.0)"), "mine = {name}:Camera")
    with open_source("mine:") as source:
        begun = time.monotonic()
        with pytest.raises(FrameTimeoutError):
            source.read(0.3)
        assert time.monotonic() - begun < 2.0


def test_with_every_frame_a_slow_loop_misses_none(plug):
    plug(LIVE, "mine = {name}:Camera")
    with open_source("mine:", SourceOptions(every_frame=True)) as source:
        frames = [source.read(5.0)]
        time.sleep(0.1)
        frames += [source.read(5.0) for _ in range(30)]
    assert [frame.index for frame in frames] == list(range(frames[0].index, frames[0].index + 31))


def test_the_contract_is_importable_without_pytest():
    program = "import sys, nurbseg.testing; sys.exit('pytest' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=60).returncode == 0
