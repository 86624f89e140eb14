"""Results as ROS 2 messages in an MCAP file, which Foxglove, Rerun and ROS 2 open."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import Writer

from nurbseg.app.errors import PublishError
from nurbseg.app.publish.published import POINT, object_points
from nurbseg.app.publish.publisher import Sink
from nurbseg.app.recording.recording import free_space
from nurbseg.common.closing import closed_on_error
from nurbseg.common.files import create_private
from nurbseg.common.limits import STAMP_END_NS
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.library.objects import MeasuredObject
from nurbseg.library.result import FrameResult

#: Results that may wait for the disk: half a second, and some 100 MB.
_WAITING_MAX = 16
#: Longest wait for the disk at the end, seconds.
_END_S = 10.0
#: Disk space that is left free, bytes.
_SPACE_MIN = 200_000_000
#: Bytes after which a chunk ends: with the points of each frame.
_CHUNK_BYTES = 500_000

DETECTIONS = "vision_msgs/msg/Detection3DArray"

_POSE = (
    f"{ros.RULE}\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\n"
    "geometry_msgs/Quaternion orientation\n"
    f"{ros.RULE}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n{ros.QUATERNION}"
)
#: Definitions of the messages, those of vision_msgs 4.
DEFINITIONS = {
    **{name: ros.DEFINITIONS[name] for name in (ros.IMAGE, ros.CAMERA_INFO, ros.TRANSFORMS, ros.POINT_CLOUD)},
    DETECTIONS: "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n"
    f"{ros.RULE}\nMSG: vision_msgs/Detection3D\nstd_msgs/Header header\n"
    "vision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\nstring id\n"
    f"{ros.RULE}\nMSG: vision_msgs/ObjectHypothesisWithPose\nvision_msgs/ObjectHypothesis hypothesis\n"
    f"geometry_msgs/PoseWithCovariance pose\n"
    f"{ros.RULE}\nMSG: vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n"
    f"{ros.RULE}\nMSG: vision_msgs/BoundingBox3D\ngeometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n"
    f"{ros.RULE}\nMSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n"
    f"{_POSE}{ros.VECTOR}{ros.HEADER}",
}

_UINT16, _FLOAT32 = 4, 7
#: Name, offset and type of a point's fields. Color is what PCL calls rgb: four bytes, said to be a float.
_FIELDS = (
    *(("x", 0, _FLOAT32), ("y", 4, _FLOAT32), ("z", 8, _FLOAT32)),
    *(("rgb", 12, _FLOAT32), ("label", 16, _UINT16)),
)


class ResultsFile(Sink):
    """Writes the messages of every frame to a new file; one without frames is removed at the end.

    Raises PublishError if the file exists or cannot be created.
    """

    waiting_max, end_s, is_file = _WAITING_MAX, _END_S, True

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path
        self._frames = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = create_private(path)
            with closed_on_error(self._file.close):
                self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
                self._schemas = {
                    name: self._writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()
                }
        except OSError as err:
            raise PublishError(f"{path}: {err.strerror or err}") from err

    def publish(self, result: FrameResult) -> None:
        """Write a frame; raises PublishError if the disk is nearly full, or its time cannot be written."""
        stamp = result.frame.timestamp_ns
        if not 0 <= stamp < STAMP_END_NS:
            raise PublishError(f"{self._path}: timestamp_ns: expected a time from 1970 to 2038, got {stamp}")
        if free_space(self._path) < _SPACE_MIN:
            raise PublishError(f"{self._path}: less than {_SPACE_MIN // 1_000_000} MB of disk space are left")
        try:
            for topic, kind, content in result_messages(result):
                self._writer.write_message(
                    topic,
                    self._schemas[kind],
                    content,
                    log_time=stamp,
                    publish_time=stamp,
                    sequence=self._frames,
                )
            self._file.flush()
        except OSError as err:
            raise PublishError(f"{self._path}: {err.strerror}; {self._frames} frames are in it") from err
        self._frames += 1

    def close(self) -> None:
        """Write the index and close the file; raises PublishError if the disk is full."""
        try:
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
            finally:
                self._file.close()
        except OSError as err:
            raise PublishError(f"{self._path}: {err.strerror}; it has no index") from err
        if not self._frames:
            self._path.unlink()


def result_messages(result: FrameResult) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the topic, type and content of each message of a frame, in the depth camera's frame.

    `/nurbseg/labels` has the label of the object of each pixel, `/nurbseg/objects` a detection for each
    object, with its label as the id and a score of 1 if it is sure, else 0. `/tf` says where the support is
    and, if the source knows it, the camera in the world.
    """
    frame, stamp = result.frame, result.frame.timestamp_ns
    # The name that a recording of the same frames gives it.
    camera = ros.COLOR_FRAME if frame.calibration.is_registered else ros.DEPTH_FRAME
    header = ros.header(stamp, camera)
    transforms = []
    if frame.world_from_camera is not None:
        transforms.append(ros.transform_message(stamp, "world", camera, frame.world_from_camera))
    support = result.objects[0].support if result.objects else None
    if support is not None:
        camera_from_support = np.asarray(np.linalg.inv(support.support_from_camera), dtype=np.float64)
        transforms.append(ros.transform_message(stamp, camera, "support", camera_from_support))
    for message in transforms:
        yield "/tf", ros.TRANSFORMS, message
    info = ros.camera_info_message(stamp, camera, frame.calibration.depth)
    yield "/nurbseg/camera_info", ros.CAMERA_INFO, info
    labels = ros.image_message(stamp, camera, result.labels("objects"), "mono16")
    yield "/nurbseg/labels", ros.IMAGE, labels
    detections = [_detection(each, header) for each in result.objects]
    yield "/nurbseg/objects", DETECTIONS, {"header": header, "detections": detections}
    yield "/nurbseg/points", ros.POINT_CLOUD, _points(result, header)


def _detection(each: MeasuredObject, header: dict[str, Any]) -> dict[str, Any]:
    pose = {
        "position": dict(zip("xyz", each.box.center_m.tolist(), strict=True)),
        "orientation": dict(zip("xyzw", each.box.quaternion.tolist(), strict=True)),
    }
    # Rows and columns are x, y, z and turns about these axes; a yaw is a turn about the box's height.
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) * each.sigma.center_m**2
    covariance[3:, 3:] = np.outer(each.box.axes[2], each.box.axes[2]) * each.sigma.yaw_rad**2
    hypothesis = {"class_id": "object", "score": float(each.is_sure)}
    return {
        "header": header,
        "id": str(each.label),
        "results": [
            {"hypothesis": hypothesis, "pose": {"pose": pose, "covariance": covariance.ravel().tolist()}}
        ],
        "bbox": {"center": pose, "size": dict(zip("xyz", each.box.size_m.tolist(), strict=True))},
    }


def _points(result: FrameResult, header: dict[str, Any]) -> dict[str, Any]:
    points = object_points(result)
    return {
        "header": header,
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": offset, "datatype": kind, "count": 1} for name, offset, kind in _FIELDS
        ],
        "is_bigendian": False,
        "point_step": POINT.itemsize,
        "row_step": points.nbytes,
        "data": points.tobytes(),
        "is_dense": True,
    }
