"""Recordings as a robot's recorder writes them: messages of ROS 2, serialized by rosbags."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import Writer
from recorded_scene import CAMERA, scene
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from nurbseg.common.frame import Intrinsics, RGBDFrame

TYPES = get_typestore(Stores.ROS2_HUMBLE)
IMAGE, COMPRESSED, INFO, IMU = (
    f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo", "Imu")
)
TRANSFORMS = "tf2_msgs/msg/TFMessage"
#: Topics of one frame, and the frame.
DEPTH, COLOR, INFO_TOPIC = "/c/depth/image", "/c/rgb/image", "/c/camera_info"
FRAME = scene(0)
#: How much later a message is logged than it was taken, nanoseconds.
LATE_NS = 7_000_000


def message(kind: str, values: Mapping[str, Any]) -> Any:
    """Return a message; fields without a value are 0 or empty."""
    fields: dict[str, Any] = {}
    for name, (node, detail) in TYPES.get_msgdef(kind).fields:
        value = values.get(name)
        if node == Nodetype.NAME:
            fields[name] = message(detail, value or {})
        elif node == Nodetype.BASE:
            fields[name] = value if value is not None else "" if detail[0] == "string" else 0
        elif detail[0][0] == Nodetype.NAME:
            fields[name] = [message(detail[0][1], element) for element in value or []]
        else:
            dtype = np.dtype(detail[0][1][0])
            given = np.frombuffer(value, dtype) if isinstance(value, bytes) else value
            fields[name] = np.asarray(np.zeros(detail[1]) if given is None else given, dtype)
    return TYPES.types[kind](**fields)


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame_id}


def image_values(stamp_ns: int, frame_id: str, image: np.ndarray, encoding: str) -> dict[str, Any]:
    """Return the fields of an Image."""
    image = np.ascontiguousarray(image, image.dtype.newbyteorder("<"))
    return {
        "header": header(stamp_ns, frame_id),
        "height": image.shape[0],
        "width": image.shape[1],
        "encoding": encoding,
        "step": image.strides[0],
        "data": image.tobytes(),
    }


def info_values(stamp_ns: int, frame_id: str, camera: Intrinsics) -> dict[str, Any]:
    """Return the fields of a CameraInfo of images that are not rectified."""
    return {
        "header": header(stamp_ns, frame_id),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "plumb_bob",
        "d": camera.distortion,
        "k": camera.matrix.ravel(),
        "r": np.eye(3).ravel(),
        "p": np.hstack([camera.matrix, np.zeros((3, 1))]).ravel(),
    }


class Bag:
    """Writes messages; those without `log_ns` are logged a little later than they were taken.

    `options` are those of the mcap library's writer.
    """

    def __init__(self, path: Path, *, little_endian: bool = True, **options: Any) -> None:
        self._little_endian = little_endian
        path.parent.mkdir(exist_ok=True)
        self.path = path
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, **{"chunk_size": 20_000} | options)
        self._writer.start(profile="ros2", library="robot")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(
        self, topic: str, kind: str, values: Mapping[str, Any], stamp_ns: int, log_ns: int | None = None
    ) -> None:
        content = bytes(TYPES.serialize_cdr(message(kind, values), kind, little_endian=self._little_endian))
        self.write(topic, kind, content, stamp_ns + LATE_NS if log_ns is None else log_ns)

    def write(self, topic: str, kind: str, content: bytes, log_ns: int) -> None:
        """Add a message that is serialized already."""
        if kind not in self._schemas:
            text, _ = TYPES.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
        self._writer.add_message(self._channels[topic], log_ns, content, log_ns)

    def image(
        self,
        topic: str,
        stamp_ns: int,
        frame_id: str,
        image: np.ndarray,
        encoding: str,
        log_ns: int | None = None,
        **values: Any,
    ) -> None:
        """Add an Image, with other values of some fields."""
        fields = image_values(stamp_ns, frame_id, image, encoding) | values
        self.add(topic, IMAGE, fields, stamp_ns, log_ns)

    def compressed(
        self, topic: str, stamp_ns: int, frame_id: str, content: bytes, form: str, log_ns: int | None = None
    ) -> None:
        fields = {"header": header(stamp_ns, frame_id), "format": form, "data": content}
        self.add(topic, COMPRESSED, fields, stamp_ns, log_ns)

    def info(
        self,
        topic: str,
        stamp_ns: int,
        frame_id: str,
        camera: Intrinsics,
        log_ns: int | None = None,
        **values: Any,
    ) -> None:
        """Add a CameraInfo, with other values of some fields."""
        self.add(topic, INFO, info_values(stamp_ns, frame_id, camera) | values, stamp_ns, log_ns)

    def transform(
        self,
        topic: str,
        stamp_ns: int,
        parent: str,
        child: str,
        matrix: np.ndarray,
        log_ns: int | None = None,
    ) -> None:
        turn = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        pose = {
            "translation": dict(zip("xyz", matrix[:3, 3], strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        }
        one = {"header": header(stamp_ns, parent), "child_frame_id": child, "transform": pose}
        self.add(topic, TRANSFORMS, {"transforms": [one]}, stamp_ns, log_ns)

    def camera(
        self, name: str, frame: RGBDFrame, camera: Intrinsics, stamp_ns: int, log_ns: int | None = None
    ) -> None:
        """Add the images of a camera that registers depth, in a frame named after it."""
        frame_id = f"{name.strip('/')}_optical"
        for kind in ("depth", "color"):
            self.info(f"{name}/{kind}/camera_info", stamp_ns, frame_id, camera, log_ns)
        self.image(f"{name}/depth/image_raw", stamp_ns, frame_id, frame.depth_mm, "16UC1", log_ns)
        self.image(f"{name}/color/image_raw", stamp_ns, frame_id, frame.color, "rgb8", log_ns)

    def close(self) -> Path:
        self._writer.finish()
        self._stream.close()
        return self.path


def bag_of(
    path: Path, depth: Callable[[Bag], None] | None = None, color: Callable[[Bag], None] | None = None
) -> Path:
    """Write a frame; depth and color are plain unless they are given."""
    bag = Bag(path / "a.mcap")
    bag.info(INFO_TOPIC, FRAME.timestamp_ns, "c", CAMERA)
    (depth or raw(DEPTH, FRAME.depth_mm, "16UC1"))(bag)
    (color or raw(COLOR, FRAME.color, "rgb8"))(bag)
    return bag.close()


def raw(topic: str, image: np.ndarray, encoding: str, **values: Any) -> Callable[[Bag], None]:
    return lambda bag: bag.image(topic, FRAME.timestamp_ns, "c", image, encoding, **values)


def packed(topic: str, content: bytes, form: str) -> Callable[[Bag], None]:
    return lambda bag: bag.compressed(topic, FRAME.timestamp_ns, "c", content, form)


def shifted(x_m: float) -> np.ndarray:
    """The (4, 4) transform of a camera beside another."""
    matrix = np.eye(4)
    matrix[0, 3] = x_m
    return matrix


def encoded(extension: str, image: np.ndarray) -> bytes:
    return cv2.imencode(extension, image)[1].tobytes()
