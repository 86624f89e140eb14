"""Reads frames of a recording by their positions, in any process."""

import logging
from collections.abc import Iterator

from nurbseg.common.errors import EndOfRecordingError, FrameFormatError
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: More frames than any recording has.
_ALL = 10**9
#: Longest wait for a frame of a recording, seconds.
_READ_TIMEOUT_S = 60.0


def survey(
    uri: str, options: SourceOptions, start: int = 0, most: int | None = None
) -> tuple[range, Calibration]:
    """Return the positions of a recording's frames, without decoding them, and its cameras.

    Raises DriverError if it cannot be opened, and ValueError if it is a camera.
    """
    with open_source(uri, options) as source:
        if source.live:
            raise ValueError(f"{uri}: a camera cannot be rewound; record it first")
        if source.depth_unit is not None:
            _log.info("depth: %s", source.depth_unit)
        first = source.skip(start)
        return range(first, first + source.skip(_ALL if most is None else most)), source.calibration


class Reader:
    """Reads frames by their positions, and keeps the last recording open, as many cannot seek."""

    def __init__(self) -> None:
        self._source: FrameSource | None = None
        self._opened: tuple[str, SourceOptions] | None = None
        self._next = 0

    def read(self, uri: str, options: SourceOptions, run: range) -> Iterator[RGBDFrame | FrameFormatError]:
        """Yield the frames at successive positions, or the error of a damaged frame.

        Raises DriverError if the recording cannot be read.
        """
        if self._source is None or self._opened != (uri, options) or self._next > run.start:
            self.close()
            self._source, self._opened, self._next = open_source(uri, options), (uri, options), 0
        self._next += self._source.skip(run.start - self._next)
        for self._next in range(run.start + 1, run.stop + 1):
            try:
                yield self._source.read(_READ_TIMEOUT_S)
            except FrameFormatError as err:
                yield err
            except EndOfRecordingError:
                return

    def close(self) -> None:
        """Close the last recording."""
        if self._source is not None:
            self._source.close()
            self._source = None
