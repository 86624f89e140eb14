"""A ROS 2 node that publishes the objects of a depth camera as vision_msgs/Detection3DArray.

python examples/ros2_node.py --ros-args -r depth:=/camera/aligned_depth_to_color/image_raw \
    -r color:=/camera/color/image_raw -r camera_info:=/camera/color/camera_info

Depth must be registered to color (RealSense: align_depth.enable:=true). It needs ROS 2 with rclpy, cv_bridge,
message_filters and vision_msgs, and was only run against stand-ins of these: there is no ROS on the computers
that it was written on.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any, Literal

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

from nurbseg import FramesSource, LiveApp, MeasuredObject, RGBDFrame


class ObjectsNode(Node):  # type: ignore[misc]
    """Takes pairs of images in, and publishes the boxes of objects on `objects`."""

    def __init__(self) -> None:
        super().__init__("nurbseg")
        self.source: FramesSource | None = None
        self.has_frames = threading.Event()
        self._bridge, self._frame_id = CvBridge(), ""
        self._objects = self.create_publisher(Detection3DArray, "objects", 1)
        topics = ((Image, "depth"), (Image, "color"), (CameraInfo, "camera_info"))
        subscribers = [Subscriber(self, kind, name) for kind, name in topics]
        self._pairs = ApproximateTimeSynchronizer(subscribers, queue_size=2, slop=0.02)
        self._pairs.registerCallback(self.put)

    def put(self, depth: Any, color: Any, info: Any) -> None:
        """Put a pair of images into the source."""
        depth_image = self._bridge.imgmsg_to_cv2(depth)
        color_image = np.ascontiguousarray(self._bridge.imgmsg_to_cv2(color, "rgb8"))
        frame = RGBDFrame.from_arrays(depth_image, color_image, info.k[0], info.k[4], info.k[2], info.k[5])
        stamp_ns = depth.header.stamp.sec * 10**9 + depth.header.stamp.nanosec
        self.source = self.source or FramesSource(frame.calibration)
        self.source.put(replace(frame, timestamp_ns=stamp_ns))
        self._frame_id = color.header.frame_id
        self.has_frames.set()

    def segment(self, view: Literal["auto", "none"] = "auto") -> None:
        """Show the newest frames, and publish their objects, until no more come."""
        self.has_frames.wait(60)
        if self.source is None:
            raise SystemExit("no images came on depth and color within a minute")
        with self.source, LiveApp(view=view) as app:
            for result in app.results(self.source):
                message = Detection3DArray()
                message.header.frame_id = self._frame_id
                stamp = message.header.stamp
                stamp.sec, stamp.nanosec = divmod(result.frame.timestamp_ns, 10**9)
                sure = [each for each in result.objects if each.is_sure]
                message.detections = [detection(each, message.header) for each in sure]
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
    node = ObjectsNode()
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    node.segment()
