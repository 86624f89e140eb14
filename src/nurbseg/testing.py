"""What every source of frames keeps to, as tests that other packages can run over their own sources.

In a test file, for a recording (of a camera, `frames` stays None):

>>> from nurbseg import open_source
>>> from nurbseg.testing import SourceContract
>>> class TestMySource(SourceContract):
...     frames = 5
...     def open(self):
...         return open_source("my-scheme:five-frames")
"""

from __future__ import annotations

import contextlib
import unittest
from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from nurbseg.common.errors import DriverError, EndOfRecordingError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.source import FrameSource

__all__ = ["SourceContract"]

#: Frames that are read of a camera, and the longest wait for one, seconds.
_SOME, _WAIT_S = 5, 5.0


def same_frame(one: RGBDFrame, other: RGBDFrame) -> bool:
    """Whether two frames have the same number, time, images and labels."""
    pixels = np.array_equal(one.depth_mm, other.depth_mm) and np.array_equal(one.color, other.color)
    if one.labels is None or other.labels is None:
        labels = one.labels is other.labels
    else:
        labels = np.array_equal(one.labels, other.labels)
    return pixels and labels and (one.index, one.timestamp_ns) == (other.index, other.timestamp_ns)


class SourceContract(ABC):
    """Tests of a source, collected by pytest in a subclass whose name begins with ``Test``.

    Attributes
    ----------
    frames : int or None
        How many the recording has, 3 at least; None for a camera.
    """

    frames: int | None = None

    @abstractmethod
    def open(self) -> FrameSource:
        """Open the source, or the same one again."""

    def test_frames_are_numbered_and_their_time_continues(self) -> None:
        """Numbers and stamps grow, and what a camera's reader did not get is counted."""
        with self.open() as source:
            frames = list(self._some(source))
            missed = source.missed
        numbers = [frame.index for frame in frames]
        assert numbers == sorted(set(numbers)), numbers
        assert numbers[-1] - numbers[0] + 1 == len(frames) + missed, (numbers, missed)
        assert missed == 0 or self.frames is None, missed
        stamps = [frame.timestamp_ns for frame in frames]
        assert stamps == sorted(set(stamps)), stamps

    def test_images_have_their_cameras_sizes_and_show_something(self) -> None:
        """Images have the sizes of the calibration, and are not empty."""
        with self.open() as source:
            for frame in self._some(source):
                for image, camera in (
                    (frame.depth_mm, source.calibration.depth),
                    (frame.color, source.calibration.color),
                ):
                    assert image.shape[:2] == (camera.height, camera.width), (image.shape, camera)
                    assert image.any()

    def test_a_frame_stays_as_it_is_when_later_ones_are_read_and_the_source_is_closed(self) -> None:
        """A frame owns its images, and nobody can change them."""
        with self.open() as source:
            first = source.read(_WAIT_S)
            depth_mm, color = first.depth_mm.copy(), first.color.copy()
            for _ in range(2):
                source.read(_WAIT_S)
        assert np.array_equal(first.depth_mm, depth_mm)
        assert np.array_equal(first.color, color)
        for image in (first.depth_mm, first.color):
            with _raises(ValueError, "read-only"):
                image[0] = 1

    def test_closing_twice_is_fine_and_reading_afterwards_is_an_error(self) -> None:
        """A closed source says so."""
        source = self.open()
        try:
            source.read(_WAIT_S)
            assert source.is_open()
        finally:
            source.close()
        source.close()
        assert not source.is_open()
        with _raises(DriverError, "closed"):
            source.read()

    def test_a_source_is_closed_when_its_block_is_left_by_an_error(self) -> None:
        """The ``with`` statement closes it."""
        with _raises(ZeroDivisionError), self.open() as source:
            raise ZeroDivisionError
        with _raises(DriverError, "closed"):
            source.read()

    def test_metadata_is_text_and_says_what_the_source_is(self) -> None:
        """Metadata are there, and texts; `live` is that of a camera."""
        with self.open() as source:
            assert source.metadata
            assert all(isinstance(each, str) for pair in source.metadata.items() for each in pair)
            assert source.live is (self.frames is None)

    def test_the_newest_frame_of_a_camera_is_there_after_one_was_read(self) -> None:
        """`latest` gives the frame that was read, or a newer one; a recording has none."""
        with self.open() as source:
            read = source.read(_WAIT_S)
            if self.frames is not None:
                with _raises(DriverError, "only a camera has a newest frame"):
                    source.latest(1000.0)
                return
            newest = source.latest(60_000.0)
            assert newest.index >= read.index
            assert same_frame(newest, read) or newest.timestamp_ns > read.timestamp_ns

    def test_a_recording_ends_and_stays_at_its_end(self) -> None:
        """It has as many frames as stated, the same each time."""
        with self._recording() as one, self.open() as other:
            frames = list(one)
            assert len(frames) == self.frames, (len(frames), self.frames)
            assert all(same_frame(a, b) for a, b in zip(frames, other, strict=True))
            for _ in range(2):
                with _raises(EndOfRecordingError):
                    one.read()

    def test_skipping_leads_to_the_frame_that_reading_leads_to(self) -> None:
        """Also to the end and beyond, and the answer is how many were skipped."""
        with self._recording() as source:
            frames = list(source)
        for passed in (0, 1, len(frames) - 1, len(frames)):
            with self.open() as source:
                assert source.skip(passed) == passed
                rest = list(source)
            assert len(rest) == len(frames) - passed, (len(rest), passed)
            assert all(same_frame(a, b) for a, b in zip(rest, frames[passed:], strict=True))
        with self.open() as source:
            source.read()
            assert source.skip(100) == len(frames) - 1
            assert source.skip(1) == 0
            with _raises(EndOfRecordingError):
                source.read()

    def test_a_recording_goes_to_any_frame_from_anywhere(self) -> None:
        """If it is seekable: to each frame, and beyond its ends to the first and the last."""
        with self._recording() as source:
            if not source.seekable:
                with _raises(DriverError, "cannot seek"):
                    source.seek(0)
                raise unittest.SkipTest("it is not seekable")
            frames = list(source)
            last = len(frames) - 1
            for read in (0, 2, len(frames)):
                for index in (*range(len(frames)), last + 100, -3):
                    source.seek(0)
                    assert source.skip(read) == read
                    source.seek(index)
                    wanted = frames[max(0, min(index, last)) :]
                    rest = list(source)
                    assert len(rest) == len(wanted), (index, read)
                    assert all(same_frame(a, b) for a, b in zip(rest, wanted, strict=True)), (index, read)
        with _raises(DriverError, "closed"):
            source.seek(0)

    def _some(self, source: FrameSource) -> Iterator[RGBDFrame]:
        return (source.read(_WAIT_S) for _ in range(self.frames or _SOME))

    def _recording(self) -> FrameSource:
        if self.frames is None:
            raise unittest.SkipTest("a camera has no end")
        return self.open()


@contextlib.contextmanager
def _raises(kind: type[Exception], text: str = "") -> Iterator[None]:
    try:
        yield
    except kind as err:
        assert text in str(err), f"expected {text!r} in {err}"
    else:
        raise AssertionError(f"expected {kind.__name__}")
