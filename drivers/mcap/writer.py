"""Writes recordings: MCAP files of ROS 2 messages, which Rerun, Foxglove and ``ros2 bag`` open too."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, get_args

import cv2
import numpy as np
from mcap.writer import Writer
from mcap_ros2.writer import Writer as Ros2Writer
from numpy.typing import NDArray

from nurbseg.common.closing import Closing, closed_on_error
from nurbseg.common.errors import DriverError, FrameFormatError, RecordingFormatError
from nurbseg.common.files import create_private
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.common.limits import STAMP_END_NS
from nurbseg.drivers.gravity import STANDARD_GRAVITY
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.mcap_file import McapFile
from nurbseg.drivers.options import ColorFormat

_VERSION = "1"
#: Topics and frames of our recordings.
DEPTH_TOPIC = "/camera/depth/image_raw"
DEPTH_INFO_TOPIC = "/camera/depth/camera_info"
COLOR_TOPIC = "/camera/color/image_raw"
COLOR_COMPRESSED_TOPIC = "/camera/color/image_raw/compressed"
COLOR_INFO_TOPIC = "/camera/color/camera_info"
TRANSFORMS_TOPIC = "/tf_static"
DEPTH_FRAME = "camera_depth_optical_frame"
COLOR_FRAME = "camera_color_optical_frame"
IMU_TOPIC = "/camera/imu"

#: JPEG of quality 95; PNG as the encoder does it by itself, which takes half the time of any set level.
_ENCODING = {"jpeg": [cv2.IMWRITE_JPEG_QUALITY, 95], "png": []}


class RecordingWriter(Closing):
    """Writes frames to an MCAP file.

    Depth is kept exactly (16UC1, millimeters). Each frame ends a chunk and so reaches the operating system
    before `write` returns, for a killed program or a full disk to take nothing of it; `close` adds the index.

    Parameters
    ----------
    path : Path
        The file, which must not exist. Only this user may read it.
    calibration : Calibration
        Of the frames.
    color_format : {"jpeg95", "png", "raw"}
        How color images are kept: JPEG of quality 95, PNG, or as they are.
    metadata : mapping of str to str, optional
        What is known of the device; replay gives it back.

    Raises
    ------
    FileExistsError
        If the file exists.
    OSError
        If it cannot be written.
    ValueError
        If `color_format` is unknown.
    """

    def __init__(
        self,
        path: Path,
        calibration: Calibration,
        *,
        color_format: ColorFormat = "jpeg95",
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        if color_format not in get_args(ColorFormat):
            expected = ", ".join(get_args(ColorFormat))
            raise ValueError(f"color_format: expected one of {expected}, got {color_format!r}")
        self.path = Path(path)
        self.frames = 0
        self._calibration = calibration
        # Registered images have one optical center, that of the color camera.
        self._depth_frame = COLOR_FRAME if calibration.is_registered else DEPTH_FRAME
        self._color_format = color_format
        self._file = create_private(self.path)
        self._closed = False
        with closed_on_error(self._file.close):
            # A chunk ends with the message that makes it larger than this: with a depth image.
            depth_bytes = 2 * calibration.depth.width * calibration.depth.height
            self._writer = Ros2Writer(self._file, chunk_size=depth_bytes)
            self._writer.add_metadata(
                ros.RECORDING_RECORD, {"version": _VERSION, "color_format": color_format}
            )
            self._writer.add_metadata(ros.DEVICE_RECORD, dict(metadata or {}))
            definitions = ros.DEFINITIONS.items()
            self._schemas = {name: self._writer.register_msgdef(name, text) for name, text in definitions}
            self._file.flush()

    def write(self, frame: RGBDFrame) -> None:
        """Add one frame.

        Raises
        ------
        ValueError
            If the frame's images have other sizes than the calibration's, or its cameras another place.
        OSError
            If the disk is full, or the file cannot be written for another reason.
        DriverError
            If the writer is closed.
        """
        if self._closed:
            raise DriverError(f"{self.path}: the recording is closed")
        self._check(frame)
        stamp = frame.timestamp_ns
        if self.frames == 0 and self._depth_frame != COLOR_FRAME:
            message = _transform_message(
                stamp, COLOR_FRAME, self._depth_frame, self._calibration.color_from_depth
            )
            self._add(TRANSFORMS_TOPIC, ros.TRANSFORMS, message, stamp)
        for topic, camera_frame, intrinsics in (
            (COLOR_INFO_TOPIC, COLOR_FRAME, frame.calibration.color),
            (DEPTH_INFO_TOPIC, self._depth_frame, frame.calibration.depth),
        ):
            info = _camera_info_message(stamp, camera_frame, intrinsics)
            self._add(topic, ros.CAMERA_INFO, info, stamp)
        if self._color_format == "raw":
            color = _image_message(stamp, COLOR_FRAME, frame.color, "rgb8")
            self._add(COLOR_TOPIC, ros.IMAGE, color, stamp)
        else:
            bgr = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
            kind = "png" if self._color_format == "png" else "jpeg"
            self._add_compressed(COLOR_COMPRESSED_TOPIC, COLOR_FRAME, frame, kind, bgr)
        if frame.labels is not None:
            # PNG, because viewers take every plain image of one channel for depth.
            self._add_compressed(ros.LABELS_TOPIC, self._depth_frame, frame, "png", frame.labels)
        for topic, schema, content in _motion_messages(frame, self._depth_frame):
            self._add(topic, schema, content, stamp)
        # Last, so that a frame whose depth is in the file is whole.
        depth = _image_message(stamp, self._depth_frame, frame.depth_mm, "16UC1")
        self._add(DEPTH_TOPIC, ros.IMAGE, depth, stamp)
        self._file.flush()
        self.frames += 1

    def close(self) -> None:
        """Write the index and close the file; safe to call twice.

        Raises
        ------
        OSError
            If the disk is full; what was written before can be replayed.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def _add_compressed(
        self, topic: str, camera_frame: str, frame: RGBDFrame, kind: str, image: NDArray[Any]
    ) -> None:
        encoded = cv2.imencode(f".{kind}", image, _ENCODING[kind])[1]
        message = {
            "header": _header(frame.timestamp_ns, camera_frame),
            "format": f"{'bgr8' if image.ndim == 3 else 'mono16'}; {kind} compressed",
            "data": encoded.tobytes(),
        }
        self._add(topic, ros.COMPRESSED_IMAGE, message, frame.timestamp_ns)

    def _add(self, topic: str, schema: str, message: object, stamp: int) -> None:
        self._writer.write_message(
            topic, self._schemas[schema], message, log_time=stamp, publish_time=stamp, sequence=self.frames
        )

    def _check(self, frame: RGBDFrame) -> None:
        """Raise ValueError if a frame does not fit the recording."""
        for name in ("depth", "color"):
            given, camera = getattr(frame.calibration, name), getattr(self._calibration, name)
            if (given.width, given.height) != (camera.width, camera.height):
                raise ValueError(
                    f"{name}: expected {camera.width}x{camera.height} as the recording's calibration, "
                    f"got {given.width}x{given.height}"
                )
        calibration, own = frame.calibration, self._calibration
        is_same_place = np.array_equal(calibration.color_from_depth, own.color_from_depth)
        if not is_same_place or calibration.is_registered != own.is_registered:
            raise ValueError("color_from_depth: expected that of the recording's calibration, got another")
        if not 0 <= frame.timestamp_ns < STAMP_END_NS:
            raise ValueError(f"timestamp_ns: expected 0 or more, before 2038, got {frame.timestamp_ns}")


def _header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame_id}


def _image_message(stamp: int, frame_id: str, image: NDArray[Any], encoding: str) -> dict[str, Any]:
    content = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("<"))
    return {
        "header": _header(stamp, frame_id),
        "height": image.shape[0],
        "width": image.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": content.strides[0],
        "data": content.tobytes(),
    }


def _camera_info_message(stamp: int, frame_id: str, camera: Intrinsics) -> dict[str, Any]:
    """Return a sensor_msgs/CameraInfo of an image that is not rectified."""
    return {
        "header": _header(stamp, frame_id),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "plumb_bob" if camera.distortion.size <= 5 else "rational_polynomial",
        "d": camera.distortion.tolist(),
        "k": camera.matrix.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def _transform_message(
    stamp: int, parent: str, child: str, parent_from_child: NDArray[np.float64]
) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation  # late: few recordings have a transform

    rotation = Rotation.from_matrix(parent_from_child[:3, :3])
    x, y, z, w = rotation.as_quat(canonical=True).tolist()
    tx, ty, tz = parent_from_child[:3, 3].tolist()
    return {
        "transforms": [
            {
                "header": _header(stamp, parent),
                "child_frame_id": child,
                "transform": {
                    "translation": {"x": tx, "y": ty, "z": tz},
                    "rotation": {"x": x, "y": y, "z": z, "w": w},
                },
            }
        ]
    }


def _motion_messages(frame: RGBDFrame, depth_frame: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield topic, schema and message of what a frame says of the camera's motion.

    The pose is that of the color camera, which is above the depth camera in the tree of transforms.
    """
    stamp = frame.timestamp_ns
    if frame.world_from_camera is not None:
        world_from_color = frame.world_from_camera @ np.linalg.inv(frame.calibration.color_from_depth)
        message = _transform_message(stamp, ros.WORLD_FRAME, COLOR_FRAME, world_from_color)
        yield ros.POSE_TOPIC, ros.TRANSFORMS, message
    if frame.gravity is not None:
        # An accelerometer at rest shows what holds it up. A covariance of -1 says that a value is not known.
        unknown = [-1.0] + [0.0] * 8
        x, y, z = (-STANDARD_GRAVITY * frame.gravity).tolist()
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        yield (
            IMU_TOPIC,
            ros.IMU,
            {
                "header": _header(stamp, depth_frame),
                "orientation": {**zero, "w": 1.0},
                "orientation_covariance": unknown,
                "angular_velocity": zero,
                "angular_velocity_covariance": unknown,
                "linear_acceleration": {"x": x, "y": y, "z": z},
                "linear_acceleration_covariance": [0.0] * 9,
            },
        )


def rewrite(path: Path, output: BinaryIO) -> int:
    """Copy the messages of a recording, as they are, and its metadata; return how many chunks were damaged.

    It may be whole or not, whoever wrote it. Attachments do not come with it. Raises RecordingFormatError if
    it is not an MCAP file or no message can be read, and OSError if the new one cannot be written.
    """
    damaged = 0
    numbers: dict[int, int] = {}
    with McapFile(path) as source:
        writer = Writer(output)
        writer.start(profile=source.profile)
        for name, values in source.metadata.items():
            writer.add_metadata(name, values)
        for item in source.every_message():
            if isinstance(item, FrameFormatError):
                damaged += 1
                continue
            channel, message = item
            if channel.id not in numbers:
                schema = source.schemas.get(channel.schema_id)
                number = schema and writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number or 0, channel.metadata
                )
            writer.add_message(
                numbers[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
    if not numbers:
        raise RecordingFormatError(f"{path}: the recording has no message that can be read")
    writer.finish()  # type: ignore[no-untyped-call]
    return damaged
