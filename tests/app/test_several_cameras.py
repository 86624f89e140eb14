"""Several cameras in one run: one is segmented, all are recorded to one file, each under names of its own."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from scripted_source import small_frame
from virtual_camera import VirtualCameras, depth_image, openni2_redist, virtual_cameras

from nurbseg.app.command.arguments import parse_arguments
from nurbseg.app.recording.recorder import Recorder
from nurbseg.app.recording.recording import FirstClock
from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source

__all__ = ["openni2_redist", "virtual_cameras"]

LIVE = [sys.executable, "-m", "nurbseg.app.command.live_command", "--view", "none"]
SECOND = SourceOptions(depth_topic="/camera_2/depth/image_raw")
THIRD = SourceOptions(depth_topic="/camera_3/depth/image_raw")


#: The first pixel of each of a virtual camera's depth images, by its number.
FIRST_MM = np.array([depth_image(number, 1, 1)[0, 0] for number in range(4000)])


def number_of(frame: RGBDFrame) -> int:
    """Return which of a virtual camera's frames this is, by its depth."""
    numbers = np.flatnonzero(frame.depth_mm[0, 0] == FIRST_MM)
    return next(int(n) for n in numbers if np.array_equal(depth_image(int(n)), frame.depth_mm))


def test_two_cameras_are_recorded_to_one_file_while_one_is_segmented(
    virtual_cameras: VirtualCameras, tmp_path: Path
) -> None:
    uris = [virtual_cameras.add(name).uri for name in ("one", "two")]
    path, report = tmp_path / "a.mcap", tmp_path / "a.json"
    words = [word for uri in uris for word in ("--device", f"openni2:{uri}")]
    words += ["--record", str(path), "--frames", "60", "--report", str(report)]
    words += ["--splits-max", "1", "--decimation", "8"]
    done = subprocess.run([*LIVE, *words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    with open_source(path) as source:
        first = list(source)
    with open_source(path, SECOND) as source:
        second = list(source)
    document = json.loads(report.read_text())
    assert len(first) == 60 and len(second) > 20
    assert document["recording"]["frames"] == len(first) + len(second)
    assert document["frames"]["segmented"] >= 1
    for frames in (first, second):
        numbers = np.array([number_of(frame) for frame in frames])
        assert (np.diff(numbers) >= 1).all()
        # Each camera's own clock is kept from frame to frame.
        times_s = np.array([frame.timestamp_ns for frame in frames]) / 1e9
        np.testing.assert_allclose(np.diff(times_s), np.diff(numbers) / 30, atol=1e-4)
    # By the first one's clock they are of one time.
    assert first[0].timestamp_ns - 2e8 < second[0].timestamp_ns < first[-1].timestamp_ns
    assert second[-1].timestamp_ns < first[-1].timestamp_ns + 2e8


def test_further_cameras_are_only_recorded(tmp_path: Path) -> None:
    config = parse_arguments(["--device", "xtion", "--device", "realsense", "--device", "A 1"]).config
    assert (config.source.device, config.source.beside) == ("xtion", "realsense,A 1")
    done = subprocess.run(
        [*LIVE, "recordings/demo.mcap", "--beside", "xtion"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2 and "expected a first camera, too (--device NAME)" in done.stderr


def test_without_a_recording_a_second_camera_is_refused(virtual_cameras: VirtualCameras) -> None:
    words = ["--device", f"openni2:{virtual_cameras.add().uri}", "--device", "xtion"]
    done = subprocess.run([*LIVE, *words], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "xtion: further cameras are only recorded, and one is segmented: give --record FILE" in done.stderr


def test_each_camera_has_names_poses_and_gravity_of_its_own(tmp_path: Path) -> None:
    frames = [small_frame(n) for n in range(3)]
    poses = [np.eye(4) for _ in frames]
    for n, pose in enumerate(poses):
        pose[0, 3] = n
    frames = [
        replace(frame, world_from_camera=pose, gravity=np.roll([0.0, 0.0, 1.0], n))
        for n, (frame, pose) in enumerate(zip(frames, poses, strict=True))
    ]
    path = tmp_path / "a.mcap"
    first, *beside = (frame.calibration for frame in frames)
    with RecordingWriter(path, first, color_format="png", beside=beside) as writer:
        for step in range(4):
            for camera, frame in enumerate(frames):
                writer.write(replace(frame, timestamp_ns=10**9 * (1 + step)), camera)
    assert writer.frames == 12
    for frame, options in zip(frames, (SourceOptions(), SECOND, THIRD), strict=True):
        with open_source(path, options) as source:
            again = list(source)
        assert len(again) == 4
        for each in again:
            np.testing.assert_array_equal(each.depth_mm, frame.depth_mm)
            np.testing.assert_allclose(each.world_from_camera, frame.world_from_camera, atol=1e-9)
            np.testing.assert_allclose(each.gravity, frame.gravity, atol=1e-9)
    with path.open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    names = ("camera_1", "camera_2", "camera_3")
    assert {f"/{name}/color/camera_info" for name in names} <= topics


def test_times_are_brought_to_the_first_ones_clock() -> None:
    clock = FirstClock()
    frame = small_frame(0)

    def came(stamp_s: float, arrived_s: float) -> RGBDFrame:
        return replace(frame, timestamp_ns=round(1e9 * stamp_s), arrived_s=arrived_s)

    def timed_s(stamp_s: float, arrived_s: float) -> float:
        found = clock.timed(1, came(stamp_s, arrived_s))
        assert found is not None
        return found.timestamp_ns / 1e9

    assert clock.timed(1, came(500.0, 10.0)) is None
    clock.first_came(came(3.0, 10.0))
    assert timed_s(500.05, 10.05) == pytest.approx(3.05)
    # It came late, but was not later.
    assert timed_s(500.1, 10.19) == pytest.approx(3.1, abs=1e-4)
    # Either clock is reset, as after a camera was plugged in again.
    assert timed_s(0.5, 11.0) == pytest.approx(4.0)
    clock.first_came(came(0.0, 12.0))
    assert timed_s(1.6, 12.1) == pytest.approx(0.1)


def test_a_clock_that_drifts_is_followed() -> None:
    """By 100 parts in a million for an hour, .36 s; frames arrive up to 10 ms late."""
    clock, frame, rng = FirstClock(), small_frame(0), np.random.default_rng(0)
    before_s, off_s = 0.0, []
    for moment_s in (1.0 + np.arange(108_000) / 30).tolist():
        for camera, rate in ((0, 1.0), (1, 1.0001)):
            arrived_s = 50.0 + moment_s + rng.uniform(0.0, 0.01)
            came = replace(frame, timestamp_ns=round(1e9 * rate * moment_s), arrived_s=arrived_s)
            if camera == 0:
                clock.first_came(came)
                continue
            timed = clock.timed(camera, came)
            assert timed is not None and timed.timestamp_ns / 1e9 >= before_s + 0.032
            before_s = timed.timestamp_ns / 1e9
            off_s.append(abs(before_s - moment_s))
    assert max(off_s) < 0.015


def test_a_further_camera_that_is_gone_ends_nothing(
    virtual_cameras: VirtualCameras, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR)
    path = tmp_path / "a.mcap"
    with open_source(f"openni2:{virtual_cameras.add('one').uri}") as one:
        two = open_source(f"openni2:{virtual_cameras.add('two').uri}")
        with Recorder(RecordConfig(file=str(path)), one, beside=[two]) as recorder:
            assert recorder.recording is not None
            closing = threading.Timer(0.5, two.close)
            closing.start()
            deadline_s = time.monotonic() + 30
            while "it is not recorded any more" not in caplog.text:
                assert time.monotonic() < deadline_s
                recorder.recording.put(one.read(5))
            recorder.recording.put(one.read(5))
    assert "camera 2: " in caplog.text
    with open_source(path) as source:
        assert len(list(source)) > 3
