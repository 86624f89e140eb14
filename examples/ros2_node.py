"""A ROS 2 node that publishes the objects of a depth camera as vision_msgs/Detection3DArray.

python examples/ros2_node.py --ros-args -r depth:=/camera/aligned_depth_to_color/image_raw \
    -r color:=/camera/color/image_raw -r camera_info:=/camera/color/camera_info

Depth must be registered to color (RealSense: align_depth.enable:=true). It needs ROS 2 with rclpy, cv_bridge,
message_filters and vision_msgs, and was only run against stand-ins of these: there is no ROS on the computers
that it was written on.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import rclpy  # type: ignore[import-not-found]
from cv_bridge import CvBridge  # type: ignore[import-not-found]
from message_filters import ApproximateTimeSynchronizer, Subscriber  # type: ignore[import-not-found]
from rclpy.node import Node  # type: ignore[import-not-found]
from sensor_msgs.msg import CameraInfo, Image  # type: ignore[import-not-found]
from vision_msgs.msg import (  # type: ignore[import-not-found]
    Detection3D,
    Detection3DArray,
    ObjectHypothesisWithPose,
)

from nurbseg import MeasuredObject, RGBDFrame, Segmenter


class ObjectsNode(Node):  # type: ignore[misc]
    """Takes pairs of images in, the newest ones, and publishes the boxes of objects on `objects`."""

    def __init__(self) -> None:
        super().__init__("nurbseg")
        self._bridge, self._segmenter = CvBridge(), Segmenter(target_hz=30.0)
        self._objects = self.create_publisher(Detection3DArray, "objects", 1)
        topics = ((Image, "depth"), (Image, "color"), (CameraInfo, "camera_info"))
        subscribers = [Subscriber(self, kind, name) for kind, name in topics]
        self._pairs = ApproximateTimeSynchronizer(subscribers, queue_size=2, slop=0.02)
        self._pairs.registerCallback(self.segment)

    def segment(self, depth: Any, color: Any, info: Any) -> None:
        """Segment a pair of images, and publish its objects."""
        depth_image = self._bridge.imgmsg_to_cv2(depth)
        color_image = np.ascontiguousarray(self._bridge.imgmsg_to_cv2(color, "rgb8"))
        stamp = depth.header.stamp
        camera = (info.k[0], info.k[4], info.k[2], info.k[5])
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        frame = RGBDFrame.from_arrays(depth_image, color_image, *camera, timestamp_ns=stamp_ns)
        result = self._segmenter.process(frame)
        message = Detection3DArray()
        message.header.frame_id = color.header.frame_id
        message.header.stamp = stamp
        message.detections = [detection(each, message.header) for each in result.objects if each.is_sure]
        self._objects.publish(message)


def detection(each: MeasuredObject, header: Any) -> Any:
    """Return the message of an object: its box, with the pose's covariance, and its label as the id."""
    message = Detection3D(header=header, id=str(each.label))
    pose, size = message.bbox.center, message.bbox.size
    pose.position.x, pose.position.y, pose.position.z = each.box.center_m.tolist()
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = each.box.quaternion.tolist()
    size.x, size.y, size.z = each.box.size_m.tolist()
    result = ObjectHypothesisWithPose()
    result.hypothesis.class_id, result.hypothesis.score = "object", 1.0
    result.pose.pose = pose
    variances = [each.sigma.center_m**2] * 3 + [0.0, 0.0, each.sigma.yaw_rad**2]
    result.pose.covariance = np.diag(variances).ravel().tolist()
    message.results.append(result)
    return message


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(ObjectsNode())
