"""Images as the library hands them out, scripted."""

import ctypes
from types import SimpleNamespace

import numpy as np
import pytest

from nurbseg.common.errors import FrameFormatError
from nurbseg.drivers.openni2.capi import OniFrame, OniVideoMode, PixelFormat, Sensor
from nurbseg.drivers.openni2.stream import Stream

#: 3 rows of 4 depths, and 4 bytes after each.
ROWS = np.arange(18, dtype=np.uint16).reshape(3, 6)


def taken(**fields):
    """What a stream takes of this frame; it must be given back whatever happens."""
    data = ctypes.create_string_buffer(ROWS.tobytes(), ROWS.nbytes)
    head = {"data": ctypes.addressof(data), "data_size": 36, "width": 4, "height": 3, "stride": 12} | fields
    mode = OniVideoMode(head.pop("pixel_format", PixelFormat.DEPTH_1_MM), 4, 3, 30)
    frame = OniFrame(mode=mode, timestamp=7, frame_index=5, **head)
    released = []

    def read(handle, found):
        found._obj.contents = frame
        return 0

    stream = Stream.__new__(Stream)
    native = SimpleNamespace(oniStreamReadFrame=read, oniFrameRelease=lambda _: released.append(True))
    stream.library, stream.sensor, stream.handle = SimpleNamespace(native=native), Sensor.DEPTH, None
    try:
        return stream.take()
    finally:
        assert released == [True]


def test_what_follows_each_row_is_left_out():
    image = taken()
    assert (image.timestamp_us, image.number) == (7, 5)
    np.testing.assert_array_equal(image.pixels, ROWS[:, :4])


@pytest.mark.parametrize(
    "fields",
    [
        {"stride": 7},
        {"data_size": 35},
        {"data_size": 0},
        {"height": 4},
        {"height": 0},
        {"width": 0},
        {"data": None},
        {"pixel_format": 99},
    ],
)
def test_an_image_that_is_not_what_its_mode_says_is_refused(fields):
    with pytest.raises(FrameFormatError, match=r"depth frame 5: \dx\d .*, \d+ bytes a row, does not fit"):
        taken(**fields)
