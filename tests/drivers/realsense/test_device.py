"""A RealSense through the real SDK, whose software device stands in for the camera."""

import logging
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from own_children import own_children
from realsense_cameras import cameras
from realsense_images import calibration_of, images

from nurbseg.common.errors import (
    BackendMissingError,
    DeviceLostError,
    DeviceNotFoundError,
    DriverError,
    FrameTimeoutError,
)
from nurbseg.drivers import open_source
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.realsense import sdk

pytest.importorskip(
    "pyrealsense2",
    reason="RealSense's SDK is missing: pip install 'nurbseg[realsense]', apt install libusb-1.0-0",
    exc_type=ImportError,
)
__all__ = ["cameras"]
VGA = (640, 480, 30)


def device(**options) -> SourceOptions:
    return SourceOptions(device=DeviceOptions(**options))


def number_of(frame, units_per_mm: float = 1.0) -> int:
    return round(int(frame.depth_mm[0, 0]) * units_per_mm)


def assert_exact(frame, depth_mode=VGA, color_mode=VGA):
    number = number_of(frame)
    np.testing.assert_array_equal(frame.depth_mm, images(number, depth_mode, "depth")[0])
    color_number = number * color_mode[2] // depth_mode[2]
    np.testing.assert_array_equal(frame.color, images(color_number, color_mode, "color")[0])


@pytest.mark.parametrize(
    ("depth", "color", "modes"),
    [
        (VGA, VGA, {}),
        ((848, 480, 30), (1280, 720, 30), {"depth_mode": "848x480", "color_mode": "1280x720"}),
        ((1280, 720, 30), (1280, 720, 15), {"depth_mode": "1280x720", "color_mode": "1280x720@15"}),
    ],
)
def test_frames_are_exact_and_have_the_cameras_clock_and_calibration(cameras, depth, color, modes):
    cameras.plug(depth=depth, color=color)
    with open_source("realsense:", device(**modes)) as source:
        frames = [source.read(10.0) for _ in range(5)]
        assert source.live
        assert source.metadata["serial"] == "935322001"
        assert source.metadata["device"] == "Intel RealSense D435"
    expected = calibration_of(depth, color)
    for frame in frames:
        assert_exact(frame, depth, color)
        assert abs(frame.timestamp_ns - 1e9 * number_of(frame) / depth[2]) < 1e6
        np.testing.assert_allclose(frame.calibration.depth.matrix, expected.depth.matrix, rtol=1e-6)
        np.testing.assert_allclose(frame.calibration.color.matrix, expected.color.matrix, rtol=1e-6)
        np.testing.assert_allclose(frame.calibration.color.distortion, expected.color.distortion, rtol=1e-6)
        np.testing.assert_allclose(frame.calibration.color_from_depth, expected.color_from_depth, atol=1e-6)
    assert not own_children()


def test_gravity_is_that_of_the_accelerometer(cameras):
    turn = cv2.Rodrigues(np.array([0.3, -0.2, 1.0]))[0]
    down = np.array([0.36, 0.8, 0.48])
    upward = -9.81 * turn @ down
    # It trembles about what it shows.
    shown = [(upward + tremble).tolist() for tremble in (0.4, -0.4)]
    cameras.plug("1", accelerometer_from_depth=turn.tolist(), accelerations=shown)
    cameras.plug("2", accelerometer_from_depth=turn.tolist(), accelerations=[(2 * upward).tolist()])
    cameras.plug("3")
    with open_source("realsense:1", device()) as source:
        frames = [source.read(10.0) for _ in range(12)][2:]
    off = [float(np.linalg.norm(frame.gravity - down)) for frame in frames]
    # One reading is .07 off; where a frame has as many of one kind as of the other, they are averaged.
    assert max(off) < 0.075 and min(off) < 0.02
    for serial in ("2", "3"):
        with open_source(f"realsense:{serial}", device()) as source:
            assert [source.read(10.0).gravity for _ in range(5)] == [None] * 5


def test_frames_that_are_kept_do_not_change_and_take_none_of_the_sdks_memory(cameras):
    """Read by this program itself, without a process between that copies them."""
    cameras.plug()
    code = """
import time

import numpy as np
from nurbseg.drivers.realsense.device import RealSenseSource
with RealSenseSource() as source:
    frames = [source.read(10.0) for _ in range(60)]
from realsense_images import images
for frame in frames:
    number = int(frame.depth_mm[0, 0])
    np.testing.assert_array_equal(frame.depth_mm, images(number, (640, 480, 30), "depth")[0])
    np.testing.assert_array_equal(frame.color, images(number, (640, 480, 30), "color")[0])
print(len(frames))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout == "60\n", done.stderr


def test_depth_in_other_units_is_in_millimeters(cameras):
    cameras.plug(units_m=0.0001)
    with open_source("realsense:", device()) as source:
        frame = source.read(10.0)
        number = number_of(frame, 10.0)
        while number == 0:
            frame = source.read(10.0)
            number = number_of(frame, 10.0)
    # The first rows, which tell the number, lose it by rounding to millimeters.
    rows = frame.depth_mm[2:].astype(int)
    candidates = [images(each, VGA, "depth")[0][2:].astype(int) for each in range(number - 6, number + 7)]
    assert min(np.abs(rows - candidate / 10).max() for candidate in candidates) <= 0.5


def test_a_loop_that_is_slow_has_the_newest_frame(cameras):
    cameras.plug()
    with open_source("realsense:", device()) as source:
        first = source.read(10.0)
        time.sleep(1.0)
        newest = source.read(1.0)
        assert newest.index - first.index > 10
        assert source.missed == newest.index - first.index - 1


def test_one_of_several_is_chosen_by_its_serial_number(cameras):
    cameras.plug("111")
    cameras.plug("222")
    with open_source("realsense:222", device()) as source:
        assert source.metadata["serial"] == "222"
    with open_source("realsense:", device(serial="222")) as source:
        assert source.metadata["serial"] == "222"
    with pytest.raises(DeviceNotFoundError, match=r"realsense:333: no such camera; .*111\), .*222\)"):
        open_source("realsense:333", device())


def test_no_camera_and_no_such_mode_are_said(cameras):
    with pytest.raises(DeviceNotFoundError, match="no such camera; connected: none"):
        open_source("realsense:", device())
    cameras.plug()
    with pytest.raises(DriverError, match=r"no depth of 320x240@60; --depth-mode can be: 640x480@30"):
        open_source("realsense:", device(depth_mode="qvga"))
    assert not own_children()


@pytest.mark.parametrize("how", ["unplugged", "silent"])
def test_without_reconnecting_a_camera_that_is_gone_is_lost(cameras, how):
    cameras.plug(**({"silent_after": 10} if how == "silent" else {}))
    options = device(reconnect=False, silence_limit_s=0.5)
    with open_source("realsense:", options) as source:
        source.read(10.0)
        if how == "unplugged":
            cameras.unplug()
        message = "was unplugged" if how == "unplugged" else r"no depth and color for 0\.5 s"
        with pytest.raises(DeviceLostError, match=message):
            for _ in range(100):
                try:
                    source.read(0.5)
                except FrameTimeoutError:
                    continue


def test_images_of_different_moments_are_no_frame(cameras):
    cameras.plug(skew_ms=12.0)
    options = SourceOptions(association_limit_s=0.005, device=DeviceOptions())
    with open_source("realsense:", options) as source, pytest.raises(FrameTimeoutError):
        source.read(2.0)


def test_usb_2_and_old_firmware_are_warned_of(cameras, caplog):
    cameras.plug(usb="2.1", firmware="5.9.14.0")
    with caplog.at_level(logging.WARNING), open_source("realsense:", device(mirror=True)):
        pass
    assert "is connected by USB 2.1" in caplog.text
    assert "has firmware 5.9.14.0, older than 5.17.0.9" in caplog.text
    assert "does not mirror" in caplog.text


def test_what_the_color_camera_does_not_accept_is_said(cameras, caplog):
    cameras.plug()
    with caplog.at_level(logging.WARNING), open_source("realsense:", device(exposure=100, gain=2)):
        pass
    assert "does not accept exposure 100" in caplog.text
    assert "does not accept gain 2" in caplog.text


def test_a_calibration_of_the_user_counts_before_the_cameras(cameras, tmp_path):
    from nurbseg.drivers.calibration.file import write_calibration

    cameras.plug()
    given = calibration_of((640, 480, 30), (640, 480, 30))
    write_calibration(tmp_path / "c.toml", given)
    with open_source("realsense:", device(calibration=str(tmp_path / "c.toml"))) as source:
        np.testing.assert_array_equal(source.calibration.color.matrix, given.color.matrix)


def test_without_the_sdk_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(BackendMissingError, match=r"pip install 'nurbseg\[realsense\]'"):
        sdk.load()
