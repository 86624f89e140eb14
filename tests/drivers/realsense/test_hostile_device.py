"""What a RealSense might state and deliver that makes no sense: a typed error, or frames at most."""

import itertools
import resource
import time

import pytest
from own_children import own_children
from realsense_cameras import cameras

from nurbseg.drivers import (
    CalibrationError,
    DeviceLostError,
    DriverError,
    FrameFormatError,
    FrameTimeoutError,
    SourceOptions,
    open_source,
)
from nurbseg.drivers.options import DeviceOptions

pytest.importorskip("pyrealsense2", reason="RealSense's SDK is missing", exc_type=ImportError)
__all__ = ["cameras"]
OPTIONS = SourceOptions(device=DeviceOptions(reconnect=False, silence_limit_s=3.0), every_frame=True)
NAN = float("nan")


@pytest.mark.parametrize(
    ("settings", "kind", "text"),
    [
        ({"units_m": 0.0}, DriverError, "depth unit of 0 m"),
        ({"units_m": NAN}, DriverError, "depth unit of nan m"),
        ({"units_m": -0.001}, DriverError, "depth unit of -0.001 m"),
        ({"stated": {"fx": NAN}}, CalibrationError, "fx: expected a finite number"),
        ({"stated": {"fx": 0.0}}, CalibrationError, "expected focal lengths"),
        ({"stated": {"coeffs": [1e30] * 5}}, CalibrationError, "give --calibration"),
        ({"stated": {"rotation": [0.0] * 9}}, CalibrationError, "expected a rigid transform"),
        ({"stated": {"rotation": [NAN] * 9}}, CalibrationError, "expected a finite"),
        ({"sensors": 1}, DriverError, "the camera has no color of 640x480@30; --color-mode can be: none"),
    ],
    ids=lambda each: str(each) if isinstance(each, dict) else "",
)
def test_what_makes_no_sense_is_refused_when_it_is_opened(cameras, settings, kind, text):
    cameras.plug(**settings)
    with pytest.raises(kind) as caught:
        open_source("realsense:", OPTIONS)
    assert text in str(caught.value)
    assert not own_children()


def taken(source, seconds: float = 3.0, enough: int = 0):
    """Frames, and what was raised, of some seconds, and until there are enough: a busy computer has few."""
    frames, errors, begun = [], [], time.monotonic()
    while (spent := time.monotonic() - begun) < seconds or (len(frames) < enough and spent < 60):
        try:
            frames.append(source.read(0.3))
        except (FrameFormatError, FrameTimeoutError) as err:
            errors.append(err)
        except DeviceLostError as err:
            errors.append(err)
            break
    return frames, errors


@pytest.mark.parametrize(
    "fault",
    ["back", "same", "negative", "nan", "infinite", "huge", "numbers back", "numbers huge", "empty", "size"],
)
def test_stamps_and_numbers_that_make_no_sense_cost_frames_at_most(cameras, fault):
    cameras.plug(fault=fault)
    enough = 26 if fault in ("back", "numbers back", "numbers huge", "empty") else 3
    with open_source("realsense:", OPTIONS) as source:
        frames, errors = taken(source, enough=enough)
        damaged = source.status.damaged_frames
    assert len(frames) >= enough, errors
    stamps = [frame.timestamp_ns for frame in frames]
    # A clock may be set back, and stand still until that is noticed.
    assert sum(b < a for a, b in itertools.pairwise(stamps)) == (fault == "back"), errors
    assert min(stamps) >= 0 and max(stamps) < 2**62
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert "crashed" not in str(errors), errors
    if fault == "size":
        assert any("320x240 pixels, expected 640x480" in text for text in damaged), errors
    assert not own_children()


@pytest.mark.parametrize("kind", ["depth", "color"])
def test_one_kind_of_image_alone_is_a_silent_camera_and_takes_no_memory(cameras, kind):
    cameras.plug(only=[kind])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with open_source("realsense:", OPTIONS) as source:
        frames, errors = taken(source, 13.0)
    assert not frames
    assert "no depth and color for" in str(errors[-1])
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


def test_a_camera_without_a_serial_number_comes_back(cameras):
    cameras.plug("0", stated_serial="")
    with open_source("realsense:", SourceOptions(device=DeviceOptions())) as source:
        first = source.read(10.0)
        cameras.unplug("0")
        with pytest.raises(FrameTimeoutError):
            for _ in range(200):
                first = source.read(0.5)
        cameras.plug("0", stated_serial="")
        deadline, after = time.monotonic() + 30, None
        while after is None and time.monotonic() < deadline:
            try:
                after = source.read(1.0)
            except FrameTimeoutError:
                continue
        assert after is not None and after.index > first.index
