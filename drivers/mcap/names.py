"""What the topics, frames and records of our recordings are called."""

from __future__ import annotations

VERSION = "1"
RECORDING_RECORD = "nurbseg"
DEVICE_RECORD = "device"

DEPTH_TOPIC = "/camera/depth/image_raw"
DEPTH_INFO_TOPIC = "/camera/depth/camera_info"
COLOR_TOPIC = "/camera/color/image_raw"
COLOR_COMPRESSED_TOPIC = "/camera/color/image_raw/compressed"
COLOR_INFO_TOPIC = "/camera/color/camera_info"
LABELS_TOPIC = "/camera/labels/image_raw/compressed"
TRANSFORMS_TOPIC = "/tf_static"

DEPTH_FRAME = "camera_depth_optical_frame"
COLOR_FRAME = "camera_color_optical_frame"
