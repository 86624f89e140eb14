"""Recordings whose frames can be loaded by number."""

import re
from abc import abstractmethod
from pathlib import Path

from nurbseg.common.errors import (
    CalibrationError,
    EndOfRecordingError,
    FrameFormatError,
    RecordingFormatError,
)
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.source import FrameSource


def natural_key(text: str) -> tuple[tuple[int, str], ...]:
    """Order names as people do: ``learn9`` before ``learn10``; and times, 0.25 s before 0.5 s."""
    text = re.sub(r"(?<=\d{9}\.)\d{1,9}", lambda part: part[0].ljust(9, "0"), text)
    parts = re.split(r"(\d+)", text.casefold())
    return tuple((int(part), "") if number % 2 else (0, part) for number, part in enumerate(parts))


class SequenceSource(FrameSource):
    """A recording of a known number of frames; subclasses fill in `_load` and set `calibration`.

    `form` is what kind of recording it is, for a person.
    """

    seekable = True

    def __init__(self, path: Path, frames: int, form: str) -> None:
        super().__init__()
        self._path, self._frames, self._next = path, frames, 0
        self.metadata = {"format": form, "frames": str(frames)}

    def __len__(self) -> int:
        return self._frames

    @abstractmethod
    def _load(self, index: int) -> RGBDFrame: ...

    def _first(self) -> RGBDFrame:
        """Return the first frame that can be loaded.

        Raises RecordingFormatError if none can, or CalibrationError if it is its calibration; says what is
        wrong with the first.
        """
        first: FrameFormatError | None = None
        for index in range(self._frames):
            try:
                return self._load(index)
            except FrameFormatError as err:
                first = first or err
        uncalibrated = first is not None and isinstance(first.__cause__, CalibrationError)
        error = CalibrationError if uncalibrated else RecordingFormatError
        raise error(f"none of the {self._frames} frames can be used; the first: {first}") from first

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._next >= self._frames:
            raise EndOfRecordingError(f"{self._path}: end after {self._frames} frames")
        # Counted first, so that a frame that cannot be loaded is skipped.
        self._next += 1
        try:
            return self._load(self._next - 1)
        except FrameFormatError as err:
            if self._path.exists():
                raise
            raise RecordingFormatError(
                f"{self._path}: the recording is gone: deleted, moved or unmounted after "
                f"{self._next - 1} of {self._frames} frames"
            ) from err

    def skip(self, frames: int) -> int:
        """Skip the next frames without loading them; return how many were skipped."""
        passed = min(frames, self._frames - self._next)
        self._next += passed
        return passed

    def _seek(self, index: int) -> None:
        self._next = max(0, min(index, self._frames - 1))

    def _close(self) -> None:
        pass
