"""Recordings as a robot's recorder writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap_ros2.writer import Writer

from nurbseg.common.frame import Intrinsics, RGBDFrame
from nurbseg.drivers.mcap import ros_messages as ros

#: How much later a message is logged than it was taken, nanoseconds.
LATE_NS = 7_000_000


class Bag:
    """Writes messages; those without `log_ns` are logged a little later than they were taken."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream = path.open("wb")
        self._writer = Writer(self._stream, chunk_size=20_000)
        self._schemas = {k: self._writer.register_msgdef(k, text) for k, text in ros.DEFINITIONS.items()}

    def add(self, topic: str, schema: str, message: Any, stamp_ns: int, log_ns: int | None = None) -> None:
        log_ns = stamp_ns + LATE_NS if log_ns is None else log_ns
        self._writer.write_message(
            topic, self._schemas[schema], message, log_time=log_ns, publish_time=log_ns
        )

    def image(
        self,
        topic: str,
        stamp_ns: int,
        frame_id: str,
        image: np.ndarray,
        encoding: str,
        log_ns: int | None = None,
    ) -> None:
        message = ros.image_message(stamp_ns, frame_id, image, encoding)
        self.add(topic, ros.IMAGE, message, stamp_ns, log_ns)

    def compressed(self, topic: str, stamp_ns: int, frame_id: str, content: bytes, form: str) -> None:
        message = {"header": ros.header(stamp_ns, frame_id), "format": form, "data": content}
        self.add(topic, ros.COMPRESSED_IMAGE, message, stamp_ns)

    def info(self, topic: str, stamp_ns: int, frame_id: str, camera: Intrinsics, **values: Any) -> None:
        """Add a CameraInfo, with other values of some fields."""
        message = ros.camera_info_message(stamp_ns, frame_id, camera) | values
        self.add(topic, ros.CAMERA_INFO, message, stamp_ns)

    def transform(self, topic: str, stamp_ns: int, parent: str, child: str, matrix: np.ndarray) -> None:
        self.add(topic, ros.TRANSFORMS, ros.transform_message(stamp_ns, parent, child, matrix), stamp_ns)

    def camera(
        self, name: str, frame: RGBDFrame, camera: Intrinsics, stamp_ns: int, log_ns: int | None = None
    ) -> None:
        """Add the images of a camera that registers depth, in a frame named after it."""
        frame_id = f"{name.strip('/')}_optical"
        for kind in ("depth", "color"):
            message = ros.camera_info_message(stamp_ns, frame_id, camera)
            self.add(f"{name}/{kind}/camera_info", ros.CAMERA_INFO, message, stamp_ns, log_ns)
        self.image(f"{name}/depth/image_raw", stamp_ns, frame_id, frame.depth_mm, "16UC1", log_ns)
        self.image(f"{name}/color/image_raw", stamp_ns, frame_id, frame.color, "rgb8", log_ns)

    def close(self) -> Path:
        self._writer.finish()
        self._stream.close()
        return self.path


def shifted(x_m: float) -> np.ndarray:
    """The (4, 4) transform of a camera beside another."""
    matrix = np.eye(4)
    matrix[0, 3] = x_m
    return matrix


def encoded(extension: str, image: np.ndarray) -> bytes:
    return cv2.imencode(extension, image)[1].tobytes()
