"""Bags of messages as other programs log them, written by rosbags."""

from pathlib import Path
from typing import Any

import numpy as np
from recorded_scene import CAMERA, RGBDFrame, scene, scenes
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_HUMBLE)
IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
FRAME = scene(0)
DEPTH, COLOR = "/camera/depth/image", "/camera/color/image"


def header(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = TYPES.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")


def image(frame: RGBDFrame, pixels: np.ndarray, encoding: str, height: int = 0) -> tuple[str, Any]:
    message = TYPES.types[IMAGE](
        header=header(frame.timestamp_ns),
        height=height or pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=np.frombuffer(pixels.tobytes(), np.uint8),
    )
    return IMAGE, message


def compressed(frame: RGBDFrame, content: bytes, form: str) -> tuple[str, Any]:
    data = np.frombuffer(content, np.uint8)
    return COMPRESSED, TYPES.types[COMPRESSED](header=header(frame.timestamp_ns), format=form, data=data)


def info(frame: RGBDFrame) -> tuple[str, Any]:
    region = TYPES.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    message = TYPES.types[INFO](
        header=header(frame.timestamp_ns),
        height=48,
        width=64,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=CAMERA.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([CAMERA.matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )
    return INFO, message


def bag(
    folder: Path, depth, color, *, plugin=StoragePlugin.MCAP, mode: CompressionMode | None = None
) -> Path:
    """Write three frames; `depth` and `color` make the messages of each."""
    writer = Writer(folder / "bag", version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for frame in scenes(3):
            for topic, make in ((DEPTH, depth), (COLOR, color), ("/camera/camera_info", info)):
                kind, message = make(frame)
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
                content = TYPES.serialize_cdr(message, kind)
                writer.write(connections[topic], frame.timestamp_ns + 1_000_000, content)
    return folder / "bag"


def plain_depth(frame: RGBDFrame) -> tuple[str, Any]:
    return image(frame, frame.depth_mm, "16UC1")


def plain_color(frame: RGBDFrame) -> tuple[str, Any]:
    return image(frame, frame.color, "rgb8")
