"""A recording read to its end, past the frames that are damaged."""

from __future__ import annotations

from pathlib import Path

from nurbseg.common.errors import EndOfRecordingError, FrameFormatError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.registry import open_source


def frames_and_errors(path: Path) -> tuple[list[RGBDFrame], list[str]]:
    """Return the frames that can be read, and what is said of each that cannot."""
    frames: list[RGBDFrame] = []
    errors: list[str] = []
    with open_source(path) as source:
        while True:
            try:
                frames.append(source.read())
            except FrameFormatError as err:
                errors.append(str(err))
            except EndOfRecordingError:
                return frames, errors
