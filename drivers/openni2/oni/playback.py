"""Replays .oni files: the structure is read here, the pixels come from OpenNI2."""

import logging
import time
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import (
    BackendMissingError,
    EndOfRecordingError,
    FrameTimeoutError,
    RecordingFormatError,
)
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.process.channel import ChannelClosedError
from nurbseg.common.process.child import ChildProcess
from nurbseg.drivers.datasets.tum import associate
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.openni2.capi import PixelFormat, Sensor
from nurbseg.drivers.openni2.configuration import calibrate
from nurbseg.drivers.openni2.oni.file import PlayedStream, read_structure
from nurbseg.drivers.openni2.stream import frame_of
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.source import FrameSource

logger = logging.getLogger(__name__)

_PLAYER = "nurbseg.drivers.openni2.oni.player"
#: The player must describe what it plays within this time, seconds; starting Python is most of it.
_OPEN_LIMIT_S = 30.0
#: And must send an image within this time, seconds, or it hangs.
_HANG_LIMIT_S = 10.0


class OniSource(FrameSource):
    """Frames of an .oni recording.

    Of the camera's options, ``calibration``, ``mirror`` and ``registration`` count. The last one decides
    whether depth is registered to color, which the file does not tell. Cameras given otherwise count where no
    calibration is named. `half_pairs` images have no other half within the association limit, and are in no
    frame; ``metadata["dropped"]`` says so too.

    Raises BackendMissingError if OpenNI2 is not installed, and RecordingFormatError if the file is damaged,
    or OpenNI2's driver crashes or hangs on it.
    """

    seekable = True

    def __init__(self, path: Path, options: SourceOptions | None = None) -> None:
        super().__init__()
        options = options or SourceOptions()
        self._path = path
        self._options = options.device or DeviceOptions()
        self._cameras, self._depth_scale = options.given_cameras(), options.depth_scale
        file = read_structure(path)
        if not file.complete:
            logger.warning("%s is truncated: its recording was cut short; it is replayed up to there", path)
        self.metadata["whole"] = str(file.complete).lower()
        self._next = 0
        self._waiting: dict[tuple[Sensor, int], NDArray[Any]] = {}
        self._player = ChildProcess(_PLAYER)
        with closed_on_error(self.close):
            version, depth, color = self._description()
            self.metadata["openni2_version"] = version
            half_period_us = 500_000 // max(1, depth.fps, color.fps)
            limit_us = min(round(options.association_limit_s * 1e6), half_period_us + 1000)
            depth_us, color_us = ([frame.timestamp_us for frame in each] for each in (file.depth, file.color))
            found = associate(depth_us, color_us, limit_us)
            self._pairs = [(file.depth[one], file.color[other]) for one, other in found]
            self.half_pairs = len(depth_us) + len(color_us) - 2 * len(found)
            self.metadata["dropped"] = str(self.half_pairs)
            self._take_description(depth, color)

    def __len__(self) -> int:
        return len(self._pairs)

    def _receive(self, timeout_s: float) -> Any:
        """Return what the player sends next: an error, or a tuple of what `play` yields; None if nothing."""
        channel = self._player.channel
        try:
            answer = channel.receive(max(0.0, timeout_s))
        except ChannelClosedError:
            code = self._player.end(_OPEN_LIMIT_S)
            raise RecordingFormatError(
                f"{self._path}: OpenNI2's file driver stopped with code {code}; the file is damaged"
            ) from None
        if answer is None and channel.silent_s >= _HANG_LIMIT_S:
            raise RecordingFormatError(
                f"{self._path}: OpenNI2's file driver hangs on it; the file is damaged"
            )
        return answer

    def _description(self) -> Any:
        """Have the player open the file; return what it says first."""
        self._player.channel.send(str(self._path.absolute()))
        answer = self._receive(_OPEN_LIMIT_S)
        if isinstance(answer, BackendMissingError):
            raise answer
        if not isinstance(answer, tuple) or answer[0] is None:
            raise RecordingFormatError(
                f"{self._path}: OpenNI2 cannot play it ({answer or 'no answer'}); perhaps only part of the "
                "file was copied"
            )
        return answer[0]

    def _take_description(self, depth: PlayedStream, color: PlayedStream) -> None:
        # A recording remembers whether its images are mirrored; they come as is wanted here.
        self._flips = depth.mirrored != self._options.mirror, color.mirrored != self._options.mirror
        is_fine = depth.pixel_format == PixelFormat.DEPTH_100_UM
        stated = DepthUnit(10_000.0 if is_fine else 1000.0, "OpenNI2's own")
        self._unit = self._state_depth_unit(decided_unit(self._depth_scale, stated, stated))
        self._tenths = self._unit is stated and is_fine
        registered = self._options.registration == "hardware"
        taken = "%s does not say whether depth is registered to color; taken as %s "
        taken += "(--registration says otherwise)"
        logger.warning(taken, self._path, "registered" if registered else "not registered")
        self.calibration = calibrate(
            (depth.width, depth.height),
            (color.width, color.height),
            (depth.fov_rad, color.fov_rad),
            self._options,
            registered=registered,
            cameras=self._cameras,
        )

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._next >= len(self._pairs):
            raise EndOfRecordingError(f"{self._path}: end after {len(self._pairs)} frames")
        stored_depth, stored_color = self._pairs[self._next]
        deadline_s = time.monotonic() + timeout_s
        wanted = {Sensor.DEPTH: stored_depth.number, Sensor.COLOR: stored_color.number}
        while not wanted.items() <= self._waiting.keys():
            if (answer := self._receive(deadline_s - time.monotonic())) is None:
                raise FrameTimeoutError(f"{self._path}: no frame within {timeout_s:g} s")
            if not isinstance(answer, tuple) or answer[0] is None:
                why = "it ends too early" if isinstance(answer, tuple) else answer
                raise RecordingFormatError(
                    f"{self._path}: frame {self._next}: OpenNI2 cannot play it ({why})"
                )
            sensor, number, pixels = answer[0]
            if number >= wanted[sensor]:
                self._waiting[sensor, number] = pixels
        depth, color = (self._waiting.pop(each) for each in wanted.items())
        self._waiting = {key: each for key, each in self._waiting.items() if key[1] > wanted[key[0]]}
        frame = frame_of(
            self._next,
            stored_depth.timestamp_us,
            depth if self._tenths else self._unit.millimeters(depth),
            color,
            self.calibration,
            tenths=self._tenths,
            flips=self._flips,
        )
        self._next += 1
        return frame

    def _seek(self, index: int) -> None:
        index = max(0, min(index, len(self._pairs) - 1))
        if index < self._next:
            # OpenNI2's own seeking hangs for good: the file is played again, and what comes before is passed.
            self._player.close()
            self._player = ChildProcess(_PLAYER)
            self._description()
        self._next = index

    def _close(self) -> None:
        self._player.close()
