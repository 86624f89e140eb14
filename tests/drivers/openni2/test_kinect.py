"""A Kinect v1 through OpenNI2, its own driver and libfreenect, which plays images in place of USB."""

import logging
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_kinect import FRAMES, color_image, depth_image, kinect, kinect_driver, openni2_redist

from nurbseg.drivers import DeviceLostError, FrameTimeoutError, SourceOptions, open_source
from nurbseg.drivers.options import DeviceOptions

__all__ = ["kinect", "kinect_driver", "openni2_redist"]


def test_its_frames_are_exact_and_have_the_computers_time_as_its_ticks_are_no_microseconds(kinect, caplog):
    options = SourceOptions(device=DeviceOptions(reconnect=False), every_frame=True)
    with caplog.at_level(logging.WARNING), open_source("openni2:kinect", options) as source:
        assert source.metadata["family"] == "kinect1"
        assert source.metadata["registration"] == "hardware"
        frames, times_s = [], []
        with pytest.raises(DeviceLostError, match="crashed the source process"):
            while True:
                frames.append(source.read(10.0))
                times_s.append(time.monotonic())
    assert FRAMES - 10 < len(frames) <= FRAMES
    for frame in frames:
        number = int(frame.depth_mm[0, 0]) - 800
        np.testing.assert_array_equal(frame.depth_mm, depth_image(number))
        # The driver takes color's newest.
        np.testing.assert_array_equal(frame.color[..., :2], color_image(number)[..., :2])
        assert abs(int(frame.color[0, 0, 2]) - number) <= 2
    passed_s = (frames[-1].timestamp_ns - frames[0].timestamp_ns) * 1e-9
    assert passed_s == pytest.approx(times_s[-1] - times_s[0], abs=1.0)
    assert "times as fast as real time; frames get the computer's time instead" in caplog.text


def test_when_it_fails_at_its_end_it_is_opened_again_and_frames_go_on(kinect):
    options = SourceOptions(device=DeviceOptions(), every_frame=True)
    with open_source("openni2:kinect", options) as source:
        numbers, stamps = [], []
        deadline = time.monotonic() + 60
        while source.losses.get("reconnections", 0) < 2 and time.monotonic() < deadline:
            try:
                frame = source.read(1.0)
            except FrameTimeoutError:
                continue
            numbers.append(frame.index)
            stamps.append(frame.timestamp_ns)
        assert source.losses["reconnections"] == 2
    assert numbers == list(range(len(numbers)))
    assert stamps == sorted(set(stamps))
    assert len(numbers) > 1.5 * FRAMES


def test_live_records_it(kinect, tmp_path):
    words = ["--device", "kinect", "--frames", "90", "--view", "none", "--record", str(tmp_path / "a.mcap")]
    live = [str(Path(sys.executable).with_name("nurbseg-live")), *words]
    done = subprocess.run(live, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert "is back; frames resume" in done.stderr
    with open_source(tmp_path / "a.mcap") as source:
        frames = list(source)
    assert len(frames) == 90
    for frame in frames:
        np.testing.assert_array_equal(frame.depth_mm, depth_image(int(frame.depth_mm[0, 0]) - 800))
