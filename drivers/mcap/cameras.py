"""The cameras of a recording, from its CameraInfo messages and transforms, at each of its frames."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, named, quoted
from nurbseg.common.frame import Calibration
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, check_distortion_model
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.motion import FindTransform
from nurbseg.drivers.mcap.pairing import Beside, StampedPair
from nurbseg.drivers.mcap.scan import Scan
from nurbseg.drivers.mcap.topics import Topics, TopicSample, unread
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

Size = tuple[int, int]
#: Largest distance of a principal point from the middle of the image, as a share of its width or height.
_OFF_MIDDLE = 0.25
_GIVE = (
    "give --calibration FILE with both cameras and their transform, or --intrinsics fx,fy,cx,cy if depth is "
    "registered to color"
)
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
                self._last = calibration
                self._changes += 1
                if self._changes <= _NAMED_MAX:
                    end = "; further changes are not said" if self._changes == _NAMED_MAX else ""
                    size = f"{calibration.depth.width} x {calibration.depth.height}"
                    text = "%s: frame %d: the cameras change, to %s with fx %.1f%s"
                    _log.warning(text, self._path, frame, size, calibration.depth.fx, end)
            self._key = key
        return self._last

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


def _camera(path: Path, image: TopicSample, info: TopicSample, size: Size | None) -> CameraModel:
    """Return the camera of a sensor_msgs/CameraInfo, for images of `size` (width, height) if that is known.

    By its definition, https://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html, rectified images have
    the camera of P and no distortion, others that of K and D; a matrix without focal length is not stated. R
    is not used: frames are those of the camera as P has it. Where the images are smaller by the binning and
    region of interest, the matrix is brought to them.
    """
    message, topic, is_rectified = info.message, named(info.topic), image.is_rectified
    matrix = np.array(message.k, dtype=np.float64).reshape(3, 3)
    projection = np.array(message.p, dtype=np.float64).reshape(3, 4)[:, :3]
    field, distortion = f"{topic}: k", np.array(message.d, dtype=np.float64)
    has_matrix, has_projection = (bool(each[0, 0] or each[1, 1]) for each in (matrix, projection))
    if not has_matrix and not has_projection:
        raise CalibrationError(
            f"{path}: {field}: the camera is not calibrated (all zeros): give --intrinsics fx,fy,cx,cy"
        )
    if has_projection and (is_rectified or not has_matrix):
        field, matrix, is_rectified = f"{topic}: p", projection, True
    if is_rectified:
        distortion = np.zeros(0)
    check_distortion_model(path, f"{topic}: distortion_model", message.distortion_model, distortion)
    full = (message.width, message.height) if message.width and message.height else None
    if full is not None and size is not None and size != full:
        matrix, full = _cropped(message, matrix, full, size, f"{path}: {topic}")
    return CameraModel(path, field, matrix, distortion, full)


def _cropped(
    message: Any, matrix: NDArray[np.float64], full: Size, size: Size, name: str
) -> tuple[NDArray[np.float64], Size]:
    """Return the matrix and size after region of interest and binning, if these lead to images of `size`."""
    roi = message.roi
    binning = np.maximum(1, [message.binning_x, message.binning_y])
    if tuple(np.array([roi.width or full[0], roi.height or full[1]]) // binning) != size:
        return matrix, full
    cropped = matrix.copy()
    cropped[:2, :2] /= binning[:, np.newaxis]
    # Pixel centers are at whole numbers.
    cropped[:2, 2] = (matrix[:2, 2] - [roi.x_offset, roi.y_offset] + 0.5) / binning - 0.5
    is_in_middle = [np.abs(each[:2, 2] / size - 0.5) < _OFF_MIDDLE for each in (cropped, matrix)]
    for axis in np.flatnonzero(~is_in_middle[0] & is_in_middle[1] & (binning > 1)):
        raise CalibrationError(
            f"{name}: binning_{'xy'[axis]}: {binning[axis]}, but the principal point at {matrix[axis, 2]:g} "
            "is that of binned images already; give --intrinsics fx,fy,cx,cy (pixels)"
        )
    return cropped, size


def recorded_cameras(
    path: Path,
    topics: Topics,
    samples: Mapping[str, TopicSample],
    find_transform: FindTransform,
    sizes: tuple[Size | None, Size | None] = (None, None),
) -> CameraFile:
    """Return the cameras of the recording itself; `sizes` are those of the depth and color images.

    One CameraInfo stands for both cameras if both images are in one frame, and so registered. Raises
    CalibrationError if there is no CameraInfo, an unusable one, or too little is said of where the cameras
    are.
    """
    shown = [samples[topic] for topic in (topics.depth, topics.color) if topic is not None]
    named_infos = zip(shown, (topics.depth_info, topics.color_info), sizes, strict=False)
    stated = [(image, samples[info], size) for image, info, size in named_infos if info is not None]
    if not stated:
        beside = " or ".join(named(image.topic) for image in shown)
        raise CalibrationError(
            f"{path}: no sensor_msgs/CameraInfo beside {beside}: give --intrinsics fx,fy,cx,cy (pixels)"
        )
    infos = [info for _, info, _ in stated]
    if len({info.topic for info in infos}) == 1:
        _check_one_frame(path, shown, infos[0].topic)
        camera = _camera(path, *stated[0])
        return CameraFile(path=path, depth=camera, color=camera)
    depth, color = (_camera(path, *each) for each in stated)
    # Some drivers name the camera's own frame in one of the two only.
    frames = [(one.frame, other.frame) for one, other in (shown, infos) if one.frame and other.frame]
    apart = [pair for pair in frames if pair[0] != pair[1]]
    transforms = (find_transform(color_frame, depth_frame) for depth_frame, color_frame in frames)
    known = (found for found in transforms if found is not None)
    between = next(known, None) if apart else _baseline(shown, infos)
    if between is None:
        one, other = map(quoted, apart[0])
        raise CalibrationError(f"{path}: no transform from {one} to {other} in a tf2_msgs/TFMessage: {_GIVE}")
    return CameraFile(path=path, depth=depth, color=color, color_from_depth=between)


def _check_one_frame(path: Path, images: list[TopicSample], info: str) -> None:
    """Check that both images are in one frame, since only one CameraInfo is there."""
    names = " and ".join(f"{named(image.topic)} in {quoted(image.frame)}" for image in images)
    frames = {image.frame for image in images}
    if len(frames) > 1 and "" in frames:
        said = "%s: %s: one names no frame: they are taken as registered, with the camera of %s"
        _log.warning(said, path, names, named(info))
    elif len(frames) > 1:
        raise CalibrationError(
            f"{path}: {names} are not registered, as their frames say, but {named(info)} is the only "
            f"CameraInfo of the two: {_GIVE}"
        )


def _baseline(images: list[TopicSample], infos: list[TopicSample]) -> NDArray[np.float64]:
    """Return color_from_depth of two rectified cameras in one frame, which P has in its last column."""
    transform = np.eye(4)
    for image, info, sign in zip(images, infos, (-1.0, 1.0), strict=True):
        if image.is_rectified:
            projection = np.array(info.message.p, dtype=np.float64).reshape(3, 4)
            focal, shift = projection[:2, :2].diagonal(), projection[:2, 3]
            transform[:2, 3] += sign * np.divide(shift, focal, out=np.zeros(2), where=focal != 0)
    return transform
