"""Recordings of RealSense's own SDK (.db3), made by it from frames of its software device."""

import logging
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded_scene import APART, scenes, write_mcap

from nurbseg.drivers import open_source

pytest.importorskip(
    "pyrealsense2",
    reason="RealSense's SDK is missing: pip install 'nurbseg[realsense]', apt install libusb-1.0-0",
    exc_type=ImportError,
)
MAKER = Path(__file__).parents[2] / "fakes" / "software_realsense.py"


def made(path, frames, *, count, units_m=0.001):
    """A process of its own: the SDK's threads stay."""
    words = [sys.executable, str(MAKER), str(path), str(frames), str(count), str(units_m)]
    subprocess.run(words, check=True, timeout=120)
    return path


def test_frames_cameras_unit_and_device_times_are_those_that_it_was_given(tmp_path, caplog):
    frames = scenes(14, APART)
    path = made(tmp_path / "a.db3", write_mcap(tmp_path / "a.mcap", frames), count=14, units_m=0.0005)
    with caplog.at_level(logging.WARNING), open_source(path) as source:
        again = list(source)
        assert source.depth_unit.units_per_meter == 2000.0
        calibration = source.calibration
    assert not caplog.records
    np.testing.assert_allclose(calibration.color_from_depth, APART.color_from_depth, atol=1e-5)
    for name in ("depth", "color"):
        np.testing.assert_allclose(getattr(calibration, name).matrix, getattr(APART, name).matrix, rtol=1e-5)
        read, given = getattr(calibration, name).distortion, getattr(APART, name).distortion
        np.testing.assert_allclose(read, given, rtol=1e-5)
    for one, other in zip(frames, again, strict=True):
        np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
        np.testing.assert_array_equal(one.color, other.color)
        # Not when they arrived: these are of a sensor's clock, in milliseconds of a double.
        assert abs(one.timestamp_ns - other.timestamp_ns) < 1000
    # Its padding differs from message to message, its cameras do not.
    assert len({id(frame.calibration) for frame in again}) == 1
