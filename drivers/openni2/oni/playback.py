"""Replays .oni files: the structure is read here, the pixels come from OpenNI2 in a process of its own."""

import logging
import time
from pathlib import Path

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import (
    BackendMissingError,
    EndOfRecordingError,
    FrameTimeoutError,
    RecordingFormatError,
)
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.datasets.tum import associate
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.openni2.capi import PixelFormat, Sensor
from nurbseg.drivers.openni2.configuration import calibrate
from nurbseg.drivers.openni2.oni.file import OniFile, StoredFrame, read_structure
from nurbseg.drivers.openni2.oni.played import OPEN_LIMIT_S, Description, Played, PlayedImage, PlayerProcess
from nurbseg.drivers.openni2.stream import frame_of
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.source import FrameSource

logger = logging.getLogger(__name__)


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
        self._pairs = self._pair(file, options.association_limit_s)
        counted = len(file.depth.frames) + len(file.color.frames)
        self.half_pairs = counted - 2 * len(self._pairs)
        self._next = 0
        self._waiting: dict[tuple[Sensor, int], PlayedImage] = {}
        self._player = PlayerProcess(path)
        with closed_on_error(self.close):
            self._take_description(file, self._description())

    def __len__(self) -> int:
        return len(self._pairs)

    def _pair(self, file: OniFile, limit_s: float) -> list[tuple[StoredFrame, StoredFrame]]:
        fps = max(file.depth.fps, file.color.fps)
        limit_us = min(round(limit_s * 1e6), 500_000 // fps + 1000)
        depth_us = [frame.timestamp_us for frame in file.depth.frames]
        color_us = [frame.timestamp_us for frame in file.color.frames]
        found = associate(depth_us, color_us, limit_us)
        return [(file.depth.frames[depth], file.color.frames[color]) for depth, color in found]

    def _description(self) -> Description:
        """Return what the player says first."""
        answer = self._player.receive(OPEN_LIMIT_S)
        if isinstance(answer, Description):
            return answer
        error = answer.error if isinstance(answer, Played) else None
        if isinstance(error, BackendMissingError):
            raise error
        raise RecordingFormatError(
            f"{self._path}: OpenNI2 cannot play it ({error or 'no answer'}); perhaps only part of the file "
            "was copied"
        )

    def _take_description(self, file: OniFile, played: Description) -> None:
        self.metadata["openni2_version"] = played.openni2_version
        self.metadata["whole"] = str(file.complete).lower()
        self.metadata["dropped"] = str(self.half_pairs)
        depth, color = played.depth, played.color
        for name, stored, each in (("depth", file.depth, depth), ("color", file.color, color)):
            if each.size != stored.size:
                raise RecordingFormatError(
                    f"{self._path}: {name}: xnMapOutputMode says {stored.size}, OpenNI2 {each.size}"
                )
        # A recording remembers whether its images are mirrored; they come as is wanted here.
        self._flips = (depth.mirrored != self._options.mirror, color.mirrored != self._options.mirror)
        stated = DepthUnit(10_000.0 if depth.format == PixelFormat.DEPTH_100_UM else 1000.0, "OpenNI2's own")
        self._unit = self._state_depth_unit(decided_unit(self._depth_scale, stated, stated))
        self._tenths = self._unit is stated and stated.units_per_meter == 10_000.0
        registered = self._options.registration == "hardware"
        logger.warning(
            "%s does not say whether depth is registered to color; "
            "taken as %s (--registration says otherwise)",
            self._path,
            "registered" if registered else "not registered",
        )
        self.calibration = calibrate(
            file.depth.size,
            file.color.size,
            (depth.fov, color.fov),
            self._options,
            registered=registered,
            cameras=self._cameras,
        )

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._next >= len(self._pairs):
            raise EndOfRecordingError(f"{self._path}: end after {len(self._pairs)} frames")
        stored_depth, stored_color = self._pairs[self._next]
        deadline = time.monotonic() + timeout_s
        wanted = {Sensor.DEPTH: stored_depth.number, Sensor.COLOR: stored_color.number}
        while not wanted.items() <= self._waiting.keys():
            answer = self._player.receive(deadline - time.monotonic())
            if answer is None:
                raise FrameTimeoutError(f"{self._path}: no frame within {timeout_s:g} s")
            if not isinstance(image := answer, PlayedImage):
                why = answer.error or "it ends too early"
                raise RecordingFormatError(
                    f"{self._path}: frame {self._next}: OpenNI2 cannot play it ({why})"
                )
            if image.number >= wanted[image.sensor]:
                self._waiting[image.sensor, image.number] = image
        depth, color = (self._waiting.pop(each) for each in wanted.items())
        self._waiting = {
            key: each for key, each in self._waiting.items() if each.number > wanted[each.sensor]
        }
        frame = frame_of(
            self._next,
            stored_depth.timestamp_us,
            depth.pixels if self._tenths else self._unit.millimeters(depth.pixels),
            color.pixels,
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
            self._player = PlayerProcess(self._path)
            self._description()
        self._next = index

    def _close(self) -> None:
        self._player.close()
