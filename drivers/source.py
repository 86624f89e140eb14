"""The base class of frame sources, and of those that wrap another."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping

from nurbseg.common.closing import Closing
from nurbseg.common.errors import DriverError, EndOfRecordingError, FrameFormatError
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.drivers.depth_unit import DepthUnit

_log = logging.getLogger(__name__)

#: Time between frames of recordings without timestamps.
FRAME_INTERVAL_NS = 33_333_333
#: Damaged frames that a loop over a source names; further ones are only counted.
_DAMAGED_NAMED_MAX = 20


class FrameSource(Closing):
    """A camera or a recording that delivers RGB-D frames one after the other.

    Constructing opens; the source is usable until `close`. Subclasses fill in `_read` and `_close`, and
    `_seek` if they are `seekable`. If frames can be loaded by number, `SequenceSource` asks only for `_load`.

    Attributes
    ----------
    calibration : Calibration
        Of the source's cameras; frames carry their own too.
    live : bool
        Whether frames are lost when nobody reads them (a camera) or wait to be read (a recording).
    seekable : bool
        Whether `seek` can go to any frame.
    silence_s : float
        Longest wait of a loop over the source for a frame, seconds.
    missed : int
        Of a camera: frames that it delivered between the first and the last that were read, but that newer
        ones replaced before they were. Always 0 of a recording.
    metadata : dict of str to str
        What is known of the device or the recording (name, serial number, ...); may be empty. ``damaged`` is
        how many frames a loop over the source skipped.
    labels_fault : str
        Why the frame read last has no labels although the recording holds some for it; else empty.
    depth_unit : DepthUnit or None
        Of a recording: the unit that its depth is read in, and why. None of a camera.
    """

    calibration: Calibration
    depth_unit: DepthUnit | None = None
    labels_fault: str = ""
    live: bool = False
    missed: int = 0
    seekable: bool = False
    silence_s: float = 10.0

    def __init__(self) -> None:
        self.metadata: dict[str, str] = {}
        self._closed = self._was_looped_over = False

    def read(self, timeout_s: float = 1.0) -> RGBDFrame:
        """Return the next frame of a recording, or the newest of a camera that was not read before.

        Of a camera, waits for a frame if all that came were read; those that newer ones replaced are counted
        as `missed`. So what is returned came since the last call, but perhaps just after it: `latest` says
        how old it may be.

        Parameters
        ----------
        timeout_s : float
            Longest wait, seconds.

        Raises
        ------
        FrameTimeoutError
            If no frame came in time; the source is still usable.
        EndOfRecordingError
            After the last frame of a recording.
        FrameFormatError
            If this one frame is damaged; the next call reads the one after it.
        DeviceLostError
            If the camera is gone.
        DriverError
            If the source is closed.
        """
        if self._closed:
            raise DriverError(f"{type(self).__name__} is closed")
        return self._read(timeout_s)

    def latest(self, max_age_ms: float) -> RGBDFrame:
        """Return a camera's newest frame, whether it was read before or not. Never waits.

        Parameters
        ----------
        max_age_ms : float
            A frame that arrived longer ago is stale, milliseconds.

        Raises
        ------
        FrameTimeoutError
            If no frame came yet, as just after opening, or the newest is stale; the camera is still usable.
        DeviceLostError
            If the camera is gone.
        DriverError
            If the source is closed, or is no camera but a recording.
        """
        raise DriverError(f"{type(self).__name__}: only a camera has a newest frame; read() the next one")

    def is_open(self) -> bool:
        """Whether frames can be read."""
        return not self._closed

    @property
    def losses(self) -> Mapping[str, int]:
        """What was lost before it could be read here, counted by reason; empty for a recording."""
        return {}

    def skip(self, frames: int) -> int:
        """Skip the next frames; return how many were skipped. A damaged frame counts as one."""
        for passed in range(frames):
            try:
                self._pass_frame()
            except FrameFormatError:
                continue
            except EndOfRecordingError:
                return passed
        return frames

    def seek(self, index: int) -> None:
        """Make the frame with this number the next to be read: 0 for the first; beyond the end, the last.

        Raises
        ------
        DriverError
            If the source cannot seek, or is closed.
        """
        if self._closed or not self.seekable:
            raise DriverError(f"{type(self).__name__} {'is closed' if self._closed else 'cannot seek'}")
        self._was_looped_over = False
        self._seek(max(0, index))

    def close(self) -> None:
        """Release what the source holds; safe to call twice."""
        if not self._closed:
            self._closed = True
            self._close()

    def _state_depth_unit(self, unit: DepthUnit) -> DepthUnit:
        """Set the unit that the recording's depth is read in, and return it."""
        self.depth_unit = unit
        self.metadata["depth_unit"] = str(unit)
        return unit

    @abstractmethod
    def _read(self, timeout_s: float) -> RGBDFrame: ...

    def _pass_frame(self) -> None:
        """Skip one frame, raising what `read` does; for subclasses that can do so without decoding it."""
        self.read()

    def _seek(self, index: int) -> None:
        """Do what `seek` says; for subclasses that are seekable."""

    @abstractmethod
    def _close(self) -> None: ...

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Yield all frames of a recording, or a camera's newest, each once.

        Damaged ones are logged, skipped and counted. A recording that was read to its end begins anew, which
        raises DriverError if it cannot seek. A camera that delivers none for `silence_s` raises
        FrameTimeoutError.
        """
        return self.frames(self._pass_over)

    def frames(self, passed_over: Callable[[FrameFormatError], None]) -> Iterator[RGBDFrame]:
        """Yield all frames as a loop over the source does; what is wrong with damaged ones is told."""
        if self._was_looped_over:
            self.seek(0)
        while True:
            try:
                frame = self.read(self.silence_s)
            except EndOfRecordingError:
                self._was_looped_over = True
                return
            except FrameFormatError as err:
                passed_over(err)
            else:
                yield frame

    def _pass_over(self, err: FrameFormatError) -> None:
        damaged = int(self.metadata.get("damaged", 0)) + 1
        self.metadata["damaged"] = str(damaged)
        if damaged <= _DAMAGED_NAMED_MAX:
            further = "; further ones are only counted" if damaged == _DAMAGED_NAMED_MAX else ""
            _log.warning("skipped a damaged frame: %s%s", err, further)


class Wrapped(FrameSource):
    """A source that wraps another one, and closes it with itself."""

    def __init__(self, source: FrameSource) -> None:
        super().__init__()
        self.calibration = source.calibration
        self.metadata = source.metadata
        self.depth_unit = source.depth_unit
        self.seekable = source.seekable
        self._source = source

    @property
    def losses(self) -> Mapping[str, int]:
        """Losses of the wrapped source."""
        return self._source.losses

    def _seek(self, index: int) -> None:
        self._source.seek(index)

    def _close(self) -> None:
        self._source.close()
