"""Results as ROS 2 messages: their definitions and contents."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from nurbseg.app.publish.published import POINT, object_points
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.library.objects import MeasuredObject
from nurbseg.library.result import FrameResult

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
