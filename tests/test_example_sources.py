"""The package of examples/sources, installed as a user does; its cameras are simulated."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import camera_sdks
import cv2
import numpy as np
import pytest
from record3d_file import CALIBRATION, write_r3d, write_zip
from recorded_scene import scenes

from nurbseg.drivers import (
    BackendMissingError,
    CalibrationError,
    DeviceLostError,
    DeviceNotFoundError,
    RecordingFormatError,
    SourceOptions,
    open_source,
)
from nurbseg.drivers.opening import open_here
from nurbseg.drivers.options import DeviceOptions
from nurbseg.testing import SourceContract

PACKAGE = Path(__file__).parent.parent / "examples" / "sources"
CAMERA = (60.0, 60.0, 31.5, 23.5)
SDKS = {"oak": "depthai", "orbbec": "pyorbbecsdk"}


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("installed")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", str(folder)]
    command = [sys.executable, "-m", "pip", "install", *options, str(PACKAGE)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def installed(target: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(target))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(target), os.environ.get("PYTHONPATH", "")]))
    return target


def stack(path: Path, frames: int = 4) -> Path:
    v, u = np.mgrid[:48, :64]
    wall = 2000 + 2 * u + np.arange(frames)[:, None, None]
    plate = (abs(u - 32) < 14) & (abs(v - 24) < 10)
    np.save(path, np.where(plate, 1000, wall).astype(np.uint16))
    return path


class TestStack(SourceContract):
    frames = 4

    @pytest.fixture(autouse=True)
    def written(self, installed: Path, tmp_path: Path) -> None:
        self.path = stack(tmp_path / "a.npy", self.frames)

    def open(self):
        return open_source(f"npy-stack:{self.path}", SourceOptions(intrinsics=CAMERA))


class TestRecord3D(SourceContract):
    frames = 4

    @pytest.fixture(autouse=True)
    def written(self, installed: Path, tmp_path: Path) -> None:
        self.path = write_r3d(tmp_path / "a.r3d", self.frames)

    def open(self):
        return open_source(f"record3d:{self.path}")

    def test_what_the_file_states_is_used(self) -> None:
        with self.open() as source:
            frames = list(source)
        for frame, expected in zip(frames, scenes(self.frames, CALIBRATION), strict=True):
            assert np.array_equal(frame.depth_mm, expected.depth_mm)
        assert frames[0].calibration.depth.fx == CALIBRATION.depth.fx
        assert frames[1].timestamp_ns == round(1e9 / 30)
        # x to the right in the image is up in the world, as the phone is turned.
        assert np.allclose(frames[0].world_from_camera @ [1, 0, 0, 1], [0, 3, 3, 1])
        assert np.allclose(frames[0].world_from_camera @ [0, 0, 1, 1], [0, 2, 2, 1])

    def test_a_damaged_frame_costs_itself_and_another_file_is_refused(self) -> None:
        with zipfile.ZipFile(self.path) as file:
            files = {name: file.read(name) for name in file.namelist()}
        write_zip(self.path, files | {"rgbd/1.depth": b"bvx2" + bytes(20)})
        with self.open() as source:
            assert [frame.index for frame in source] == [0, 2, 3]
        write_zip(self.path, {"metadata": b"{}"})
        with pytest.raises(RecordingFormatError, match=r"a\.r3d: is no recording of Record3D"):
            self.open()


class TestCameras(SourceContract):
    @pytest.fixture(autouse=True, params=SDKS)
    def connected(self, installed: Path, monkeypatch: pytest.MonkeyPatch, request) -> None:
        camera_sdks.connect(monkeypatch, SDKS[request.param])
        self.scheme = request.param

    def open(self):
        return open_source(f"{self.scheme}:")


def test_a_camera_that_is_gone_is_lost(installed, monkeypatch):
    camera_sdks.connect(monkeypatch, "depthai", frames=30)
    options = SourceOptions(device=DeviceOptions(reconnect=False))
    with open_source("oak:", options) as source, pytest.raises(DeviceLostError, match="was unplugged"):
        for _ in range(40):
            source.read(2.0)


@pytest.mark.parametrize("scheme", SDKS)
def test_a_camera_without_its_sdk_is_an_error_of_one_line(installed, monkeypatch, scheme):
    monkeypatch.setitem(sys.modules, SDKS[scheme], None)
    with pytest.raises(BackendMissingError, match=rf"{scheme} \(package nurbseg-example-sources 1\.0\)"):
        open_here(f"{scheme}:", SourceOptions())


def test_what_the_cameras_state_is_used(installed, monkeypatch):
    camera_sdks.connect(monkeypatch, "pyorbbecsdk")
    with open_source("orbbec:AY1") as source:
        frame = source.read(5.0)
    assert np.array_equal(frame.depth_mm, np.rint(camera_sdks.DEPTH * 0.5))
    assert frame.calibration.color_from_depth[0, 3] == -0.025
    assert frame.calibration.depth.distortion.tolist() == [0.1, -0.05, 0, 0, 0, 0, 0, 0]
    with pytest.raises(DeviceNotFoundError, match="orbbec:AY2: no such camera; connected: AY1"):
        open_source("orbbec:AY2")


def test_the_commands_open_it(installed: Path, tmp_path: Path):
    path = stack(tmp_path / "a.npy")
    bin_folder, camera = Path(sys.executable).parent, ",".join(map(str, CAMERA))
    report = tmp_path / "report.json"
    words = ["--replay", f"npy-stack:{path}", "--intrinsics", camera, "--speed", "0", "--view", "none"]
    live = [str(bin_folder / "nurbseg-live"), *words, "--report", str(report)]
    done = subprocess.run(live, capture_output=True, text=True, timeout=240, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(report.read_text())["frames"]["segmented"] == 4
    # In a process of its own, too.
    words = [f"npy-stack:{path}", "--export", "out", "--workers", "2", "--intrinsics", camera]
    batch = [str(bin_folder / "nurbseg-batch"), *words]
    done = subprocess.run(batch, capture_output=True, text=True, timeout=240, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "4 of 4 frames" in done.stderr + done.stdout


class SimulatedCapture:
    """What OpenCV's capture of an OpenNI2 camera answers, as its documentation says."""

    def __init__(self, number: int, api: int) -> None:
        assert api == cv2.CAP_OPENNI2
        self._is_there, self._left = number == 0, 60

    def isOpened(self) -> bool:
        return self._is_there

    def set(self, key: int, value: float) -> None:
        assert (key, value) == (cv2.CAP_PROP_OPENNI_REGISTRATION, 1)

    def get(self, key: int) -> float:
        assert key == cv2.CAP_OPENNI_DEPTH_GENERATOR_FOCAL_LENGTH
        return 130.0

    def grab(self) -> bool:
        self._left -= 1
        return self._left >= 0

    def retrieve(self, flag: int) -> tuple[bool, np.ndarray]:
        bgr = np.full((48, 64, 3), (9, 5, 1), np.uint8)
        return True, {cv2.CAP_OPENNI_DEPTH_MAP: camera_sdks.DEPTH, cv2.CAP_OPENNI_BGR_IMAGE: bgr}[flag]

    def release(self) -> None:
        self._left = 0


def test_frames_of_opencv_are_a_source(installed, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", SimulatedCapture)
    with open_here("opencv:", SourceOptions()) as source:
        frame = source.read(5.0)
        assert frame.color[0, 0].tolist() == [1, 5, 9]
        assert np.array_equal(frame.depth_mm, camera_sdks.DEPTH)
        assert (frame.calibration.depth.fx, frame.calibration.depth.cx) == (130.0, 31.5)
        with pytest.raises(DeviceLostError, match="nothing more"):
            for _ in range(100):
                source.read(2.0)
    with pytest.raises(DeviceNotFoundError, match="opencv:1: no such camera"):
        open_here("opencv:1", SourceOptions())


@pytest.mark.parametrize("scheme", SDKS)
def test_live_says_what_a_camera_lacks_in_one_line(installed: Path, scheme: str):
    words = ["--device", f"{scheme}:", "--view", "none"]
    # A module of that name which cannot be imported stands for one that is not installed.
    (blocked := installed / SDKS[scheme]).mkdir(exist_ok=True)
    (blocked / "__init__.py").write_text("raise ImportError('not installed')")
    try:
        live = [str(Path(sys.executable).with_name("nurbseg-live")), *words]
        done = subprocess.run(live, capture_output=True, text=True, timeout=120)
    finally:
        (blocked / "__init__.py").unlink()
        blocked.rmdir() if not any(blocked.iterdir()) else None
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if line]
    assert len(said) == 1
    assert f"{scheme} (package nurbseg-example-sources 1.0): cannot be imported" in said[0]


def test_a_file_that_is_none_is_said(installed: Path, tmp_path: Path):
    (tmp_path / "b.npy").write_bytes(b"\x93NUMPY\1\0v\0")
    np.save(tmp_path / "flat.npy", np.zeros((4, 4), np.uint16))
    for name, kind in (("b.npy", RecordingFormatError), ("flat.npy", RecordingFormatError)):
        with pytest.raises(kind, match=name):
            open_source(f"npy-stack:{tmp_path / name}")
    with pytest.raises(DeviceNotFoundError):
        open_source(f"npy-stack:{tmp_path / 'absent.npy'}")
    with pytest.raises(CalibrationError, match="give --intrinsics"):
        open_source(f"npy-stack:{stack(tmp_path / 'a.npy')}")


def test_every_scheme_is_tested_and_documented():
    table = tomllib.loads((PACKAGE / "pyproject.toml").read_text())
    schemes = set(table["project"]["entry-points"]["nurbseg.sources"])
    assert schemes == {"npy-stack", "opencv", "record3d", *SDKS}
    page = (PACKAGE.parent.parent / "docs" / "library.md").read_text()
    assert all(f"`{scheme}:" in page for scheme in schemes)
