"""The cameras of a recording, from its CameraInfo messages and transforms."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, named, quoted
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, check_distortion_model
from nurbseg.drivers.mcap.topics import Topics, TopicSample, frame_of, is_rectified, says_registered

_log = logging.getLogger(__name__)

Size = tuple[int, int]
#: Finds the (4, 4) target_from_source of two frames; None where the recording does not say.
FindTransform = Callable[[str, str], NDArray[np.float64] | None]

#: A principal point outside of the middle of the image, as shares of its width or height.
_MIDDLE = (0.25, 0.75)
#: Rectifying an image changes the focal length less than this, as a share.
_FOCAL_UNLIKE = 0.1
_GIVE = (
    "give --calibration FILE with both cameras and their transform, or --intrinsics fx,fy,cx,cy if depth is "
    "registered to color"
)


def camera_of(
    message: Any, path: Path, topic: str, *, rectified: bool, size: Size | None = None
) -> CameraModel:
    """Return the camera of a sensor_msgs/CameraInfo, for images of `size` (width, height) if that is known.

    Rectified images have the camera of P and no distortion, others that of K and D [1]_; where one of the two
    matrices has no focal length the other one counts. R is not used: frames are those of the camera as P has
    it. Where the images are smaller than width and height by the binning and region of interest, the matrix
    is brought to them. Raises CalibrationError if it is not calibrated, contradicts itself or has a lens
    model that is not OpenCV's.

    References
    ----------
    .. [1] ROS, sensor_msgs/CameraInfo, https://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html
    """
    topic = named(topic)
    matrix = np.array(message.k, dtype=np.float64).reshape(3, 3)
    projection = np.array(message.p, dtype=np.float64).reshape(3, 4)[:, :3]
    field, distortion = f"{topic}: k", np.array(message.d, dtype=np.float64)
    has_matrix, has_projection = (bool(each[0, 0] or each[1, 1]) for each in (matrix, projection))
    if not has_matrix and not has_projection:
        raise CalibrationError(
            f"{path}: {field}: the camera is not calibrated (all zeros): give --intrinsics fx,fy,cx,cy"
        )
    if has_projection and (rectified or not has_matrix):
        field, matrix, rectified = f"{topic}: p", projection, True
    if rectified:
        distortion = np.zeros(0)
    check_distortion_model(path, f"{topic}: distortion_model", message.distortion_model, distortion)
    full = (message.width, message.height) if message.width and message.height else None
    if full is not None and size not in (None, full):
        matrix, full = _cropped(message, matrix, full, size, f"{path}: {topic}")
    return CameraModel(path, field, matrix, distortion, full)


def _cropped(
    message: Any, matrix: NDArray[np.float64], full: Size, size: Size | None, name: str
) -> tuple[NDArray[np.float64], Size]:
    """Return the matrix and size after region of interest and binning, if these lead to images of `size`."""
    roi = message.roi
    region = (roi.width or full[0], roi.height or full[1])
    binning = (max(1, message.binning_x), max(1, message.binning_y))
    if size != (region[0] // binning[0], region[1] // binning[1]):
        return matrix, full
    cropped = matrix.copy()
    for axis, start in enumerate((roi.x_offset, roi.y_offset)):
        cropped[axis, :2] /= binning[axis]
        # Pixel centers are at whole numbers.
        cropped[axis, 2] = (matrix[axis, 2] - start + 0.5) / binning[axis] - 0.5
        is_in_middle = [_MIDDLE[0] < each[axis, 2] / size[axis] < _MIDDLE[1] for each in (cropped, matrix)]
        if is_in_middle == [False, True] and binning[axis] > 1:
            field = f"{name}: binning_{'xy'[axis]}"
            raise CalibrationError(
                f"{field}: {binning[axis]}, but the principal point at {matrix[axis, 2]:g} is that of binned "
                "images already; give --intrinsics fx,fy,cx,cy (pixels)"
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
    infos = [topics.depth_info, topics.color_info]
    present = [info for info in infos if info is not None]
    if not present:
        beside = " or ".join(named(topic) for topic in (topics.depth, topics.color) if topic is not None)
        raise CalibrationError(
            f"{path}: no sensor_msgs/CameraInfo beside {beside}: give --intrinsics fx,fy,cx,cy (pixels)"
        )
    if topics.color is None:
        camera = _camera(path, present[0], topics.depth, samples, sizes[0])
        return CameraFile(path=path, depth=camera, color=camera)
    images = (topics.depth, topics.color)
    frames = tuple(frame_of(samples[image]) for image in images)
    if len(set(present)) == 1:
        _check_one_frame(path, images, (frames[0], frames[1]), present[0])
        own = 0 if present[0] == topics.depth_info else 1
        camera = _camera(path, present[0], images[own], samples, sizes[own])
        return CameraFile(path=path, depth=camera, color=camera)
    depth, color = (
        _camera(path, info, image, samples, size)
        for info, image, size in zip(present, images, sizes, strict=True)
    )
    info_frames = tuple(frame_of(samples[info]) for info in present)
    # Some drivers name the camera's own frame in one of the two only.
    apart = next((each for each in (frames, info_frames) if each[0] != each[1] and all(each)), None)
    if apart is None:
        if sizes[0] == sizes[1] and says_registered(topics.depth):
            depth = _of_registered_depth(path, present, depth, color)
        same = depth.size == color.size and np.array_equal(depth.matrix, color.matrix)
        same = same and np.array_equal(depth.distortion, color.distortion)
        between = _baseline(topics, samples)
        if same and np.array_equal(between, np.eye(4)):
            color = depth
        return CameraFile(path=path, depth=depth, color=color, color_from_depth=between)
    transform = next(
        (
            found
            for depth_frame, color_frame in (frames, info_frames)
            if depth_frame and color_frame and (found := find_transform(color_frame, depth_frame)) is not None
        ),
        None,
    )
    if transform is None:
        raise CalibrationError(
            f"{path}: no transform from {quoted(apart[0])} to {quoted(apart[1])} in a tf2_msgs/TFMessage: "
            f"{_GIVE}"
        )
    return CameraFile(path=path, depth=depth, color=color, color_from_depth=transform)


def _camera(
    path: Path, info: str, image: str, samples: Mapping[str, TopicSample], size: Size | None
) -> CameraModel:
    return camera_of(samples[info].message, path, info, rectified=is_rectified(image), size=size)


def _of_registered_depth(path: Path, infos: list[str], depth: CameraModel, color: CameraModel) -> CameraModel:
    """Return the camera of depth that is named as registered to color, in color's frame.

    Some drivers state the depth camera's own matrix beside it.
    """
    focal = np.array([camera.matrix[[0, 1], [0, 1]] for camera in (depth, color)])
    if np.abs(focal[0] / focal[1] - 1.0).max() < _FOCAL_UNLIKE:
        return depth
    _log.warning(
        "%s: %s (fx %g) contradicts %s (fx %g), though depth is registered to color: the latter counts; "
        "if that is wrong, give --calibration FILE",
        path,
        named(infos[0]),
        focal[0, 0],
        named(infos[1]),
        focal[1, 0],
    )
    return color


def _check_one_frame(path: Path, images: tuple[str, str], frames: tuple[str, str], info: str) -> None:
    """Check that both images are in one frame, since only one CameraInfo is there."""
    if frames[0] == frames[1]:
        return
    if not all(frames):
        _log.warning(
            "%s: %s or %s names no frame: they are taken as registered, with the camera of %s",
            path,
            *map(named, images),
            named(info),
        )
        return
    raise CalibrationError(
        f"{path}: {named(images[0])} is in the frame {quoted(frames[0])} and {named(images[1])} in "
        f"{quoted(frames[1])}, so they are not registered, but {named(info)} is the only CameraInfo of the "
        f"two: {_GIVE}"
    )


def _baseline(topics: Topics, samples: Mapping[str, TopicSample]) -> NDArray[np.float64]:
    """Return color_from_depth of two rectified cameras in one frame, which P has in its last column."""
    transform = np.eye(4)
    pairs = ((topics.depth, topics.depth_info, -1.0), (topics.color, topics.color_info, 1.0))
    for image, info, sign in pairs:
        if image is not None and info is not None and is_rectified(image):
            projection = np.array(samples[info].message.p, dtype=np.float64).reshape(3, 4)
            for axis in (0, 1):
                if projection[axis, axis]:
                    transform[axis, 3] += sign * projection[axis, 3] / projection[axis, axis]
    return transform


def chained(
    target: str, source: str, transforms: list[tuple[str, str, NDArray[np.float64]]]
) -> NDArray[np.float64] | None:
    """Return target_from_source, chained from transforms of parents and children; None if there is none."""
    steps: dict[str, list[tuple[str, NDArray[np.float64]]]] = {}
    for parent, child, matrix in transforms:
        steps.setdefault(child, []).append((parent, matrix))
        steps.setdefault(parent, []).append((child, np.asarray(np.linalg.inv(matrix), dtype=np.float64)))
    reached = {source: np.eye(4)}
    waiting = [source]
    while waiting:
        frame = waiting.pop()
        for other, other_from_frame in steps.get(frame, []):
            if other not in reached:
                reached[other] = other_from_frame @ reached[frame]
                waiting.append(other)
    return reached.get(target)
