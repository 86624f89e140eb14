"""The calibration of a recording's frames, by what its CameraInfo says at each of them."""

import logging
from pathlib import Path

from nurbseg.common.errors import CalibrationError, named
from nurbseg.common.frame import Calibration
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.cameras import Size, recorded_cameras
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.pairing import Beside, StampedPair
from nurbseg.drivers.mcap.scan import Scan
from nurbseg.drivers.mcap.topics import Topics, TopicSample, unread
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

#: Changes that are logged.
_NAMED_MAX = 3
#: What comes before all that can be different in two CameraInfo of one camera.
_STAMP_BYTES = 12


class Calibrations:
    """Chooses the first of several cameras that is calibrated, and follows it through the recording.

    `topics` are its, `first` is its calibration for the first images. Cameras that the user gives count
    before the recording's; `depth_unit` is what they state. Raises CalibrationError if no camera is
    calibrated.
    """

    def __init__(self, path: Path, cameras: list[Topics], scan: Scan, options: SourceOptions) -> None:
        self._path, self._samples = path, scan.samples
        self._find_transform = scan.find_transform
        self._given = options.given_cameras()
        self.depth_unit = None if self._given is None else self._given.depth_unit
        self._key: tuple[object, ...] = ()
        self._changes = 0
        self.topics, self.first = self._first_calibrated(cameras)
        self._last = self.first
        names = {scan.samples[camera.depth].camera for camera in cameras}
        if len(names) > 1:
            _log.warning(
                "%s: has %d cameras: %s is replayed with %s; --depth-topic and --color-topic choose another",
                path,
                len(names),
                named(self.topics.depth),
                named(self.topics.color or "gray for color"),
            )
        elif self.topics.color is None:
            text = "%s: has no color images of the camera of %s: gray instead%s"
            _log.warning(text, path, named(self.topics.depth), unread(scan.samples))

    def at(
        self,
        pair: StampedPair,
        beside: Beside,
        depth_shape: tuple[int, ...],
        color_shape: tuple[int, ...],
        frame: int,
    ) -> Calibration:
        """Return the calibration for the images of a frame.

        Raises CalibrationError if what its CameraInfo says does not fit the images, and FrameFormatError if
        it cannot be read.
        """
        depth_size, color_size = (depth_shape[1], depth_shape[0]), (color_shape[1], color_shape[0])
        near = {topic: beside.near(topic, pair.log_ns) for topic in sorted(self.info_topics)}
        infos = {topic: content for topic, content in near.items() if content and self._given is None}
        key = (depth_size, color_size, *(content[_STAMP_BYTES:] for content in infos.values()))
        if key != self._key:
            samples = dict(self._samples)
            for topic, content in infos.items():
                message = ros.decode(content, ros.CAMERA_INFO, f"{self._path}: {named(topic)}")
                samples[topic] = TopicSample(topic, ros.CAMERA_INFO, message)
            calibration = self._calibration(self.topics, samples, (depth_size, color_size))
            # Some writers leave anything between the fields of a message.
            if not self._last.equals(calibration):
                self._say_change(frame, calibration)
                self._last = calibration
            self._key = key
        return self._last

    def _say_change(self, frame: int, calibration: Calibration) -> None:
        self._changes += 1
        if self._changes <= _NAMED_MAX:
            depth = calibration.depth
            _log.warning(
                "%s: frame %d: the cameras change, to %d x %d with fx %.1f%s",
                self._path,
                frame,
                depth.width,
                depth.height,
                depth.fx,
                "; further changes are not said" if self._changes == _NAMED_MAX else "",
            )

    @property
    def info_topics(self) -> set[str]:
        """The topics of the cameras' CameraInfo."""
        return {each for each in (self.topics.depth_info, self.topics.color_info) if each is not None}

    def _first_calibrated(self, cameras: list[Topics]) -> tuple[Topics, Calibration]:
        """Return the first camera that is calibrated, and its calibration for the first images."""
        errors = []
        for topics in cameras if self._given is None else cameras[:1]:
            depth, color = self._samples[topics.depth], self._samples.get(topics.color or "")
            # Where the first image is damaged, CameraInfo has the size.
            sizes = (
                images.size_of(depth.message, depth.schema, topics.depth, is_depth=True),
                None if color is None else images.size_of(color.message, color.schema, "", is_depth=False),
            )
            try:
                return topics, self._calibration(topics, self._samples, sizes)
            except CalibrationError as err:
                errors.append(err)
        raise errors[0]

    def _calibration(
        self, topics: Topics, samples: dict[str, TopicSample], sizes: tuple[Size | None, Size | None]
    ) -> Calibration:
        cameras = self._given or recorded_cameras(self._path, topics, samples, self._find_transform, sizes)
        if topics.color is None:
            # Gray has the place of depth, whatever is known of a color camera.
            return Calibration.registered(cameras.depth.intrinsics(sizes[0]))
        return cameras.calibration(depth_size=sizes[0], color_size=sizes[1])
