"""The ROS 2 messages of a recording: their definitions and names, stamps and transforms."""

import functools
from itertools import zip_longest
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, RecordingFormatError, named, quoted
from nurbseg.common.frame import Intrinsics

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"

#: Of our own recordings.
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
POSE_TOPIC, IMU_TOPIC = "/tf", "/camera/imu"

WORLD_FRAME = "world"
DEPTH_FRAME = "camera_depth_optical_frame"
COLOR_FRAME = "camera_color_optical_frame"

#: Parts of definitions.
RULE = "=" * 80
_TIME = f"{RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
VECTOR = f"{RULE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
QUATERNION = f"{RULE}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
HEADER = f"{RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
#: The message definitions as a recording states them.
DEFINITIONS = {
    IMAGE: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    f"uint32 step\nuint8[] data\n{HEADER}",
    COMPRESSED_IMAGE: f"std_msgs/Header header\nstring format\nuint8[] data\n{HEADER}",
    CAMERA_INFO: "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
    "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
    f"sensor_msgs/RegionOfInterest roi\n{HEADER}{RULE}\nMSG: sensor_msgs/RegionOfInterest\n"
    "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n"
    f"{RULE}\nMSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    f"geometry_msgs/Transform transform\n{RULE}\nMSG: geometry_msgs/Transform\n"
    f"geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n{VECTOR}{QUATERNION}{HEADER}",
    POINT_CLOUD: "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    f"{RULE}\nMSG: sensor_msgs/PointField\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    f"{HEADER}",
    IMU: "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
    f"{VECTOR}{QUATERNION}{HEADER}",
}

#: ROS 2's libraries know it without a definition.
_TIME_NAME = "Time"

_FAR_M = 1e6

#: The names of two frames, parent and child, and the (4, 4) parent_from_child.
Transform = tuple[str, str, NDArray[np.float64]]


@functools.cache
def _decoder(name: str) -> Any:
    schema = Schema(id=1, name=name, encoding="ros2msg", data=DEFINITIONS[name].encode())
    return DecoderFactory().decoder_for("cdr", schema)


def decode(content: bytes, schema: str, name: str) -> Any:
    """Decode a message by our definition of its schema, which `check_schema` found to be the recording's.

    Raises FrameFormatError if the message is damaged; calls it `name`.
    """
    try:
        return _decoder(schema)(content)
    except Exception as err:  # The decoder raises whatever a damaged message leads it to.
        raise FrameFormatError(f"{name}: the message is damaged ({quoted(str(err))})") from err


def check_schema(schema: Schema, name: str) -> None:
    """Check that a recording's schema with the name of one of `DEFINITIONS` is that of ROS 2.

    Raises RecordingFormatError if a message of it lacks a field or has another; names the field.
    """
    name = f"{name}: schema {schema.name}"
    if schema.encoding != "ros2msg":
        raise RecordingFormatError(f"{name}: encoding: expected ros2msg, got {quoted(schema.encoding)}")
    stated = _fields(schema.data.decode(errors="replace"))
    for message, expected in _fields(DEFINITIONS[schema.name]).items():
        if message == _TIME_NAME and message not in stated:
            continue
        pairs = zip_longest(expected, stated.get(message, []), fillvalue="nothing")
        for place, (one, other) in enumerate(pairs, 1):
            if one != other:
                raise RecordingFormatError(
                    f"{name}: {named(message or 'field')} {place}: expected {one!r}, got {quoted(other)}"
                )


def _fields(text: str) -> dict[str, list[str]]:
    """Return the types and names of the fields of a definition, and of those it is made of, by message."""
    found: dict[str, list[str]] = {"": []}
    message = ""
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if words[:1] == ["MSG:"] and len(words) == 2:
            message = words[1].rpartition("/")[2]
            found.setdefault(message, [])
        # A constant is no field; a default value after the name changes nothing.
        elif len(words) >= 2 and "=" not in words[1] and words[2:3] != ["="]:
            # A package may be named or not. D, K, R and P of older definitions are d, k, r and p.
            found[message].append(f"{words[0].rpartition('/')[2]} {words[1].lower()}")
    return found


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    """Return a std_msgs/Header."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame_id}


def stamp_fields(content: bytes) -> tuple[int, int]:
    """Return the seconds and nanoseconds of a message that begins with a header, without decoding it."""
    order: Any = "little" if content[1] & 1 else "big"
    return int.from_bytes(content[4:8], order, signed=True), int.from_bytes(content[8:12], order)


def stamp_ns(content: bytes) -> int:
    """Return the stamp of such a message, nanoseconds."""
    seconds, nanoseconds = stamp_fields(content)
    return seconds * 1_000_000_000 + nanoseconds


def image_message(stamp: int, frame_id: str, image: NDArray[Any], encoding: str) -> dict[str, Any]:
    """Return a sensor_msgs/Image of an (H, W[, C]) array."""
    content = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("<"))
    return {
        "header": header(stamp, frame_id),
        "height": image.shape[0],
        "width": image.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": content.strides[0],
        "data": content.tobytes(),
    }


def camera_info_message(stamp: int, frame_id: str, camera: Intrinsics) -> dict[str, Any]:
    """Return a sensor_msgs/CameraInfo of an image that is not rectified."""
    return {
        "header": header(stamp, frame_id),
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


def transform_message(
    stamp: int, parent: str, child: str, parent_from_child: NDArray[np.float64]
) -> dict[str, Any]:
    """Return a tf2_msgs/TFMessage of one (4, 4) transform."""
    from scipy.spatial.transform import Rotation  # late: few recordings have a transform

    rotation = Rotation.from_matrix(parent_from_child[:3, :3])
    x, y, z, w = rotation.as_quat(canonical=True).tolist()
    tx, ty, tz = parent_from_child[:3, 3].tolist()
    return {
        "transforms": [
            {
                "header": header(stamp, parent),
                "child_frame_id": child,
                "transform": {
                    "translation": {"x": tx, "y": ty, "z": tz},
                    "rotation": {"x": x, "y": y, "z": z, "w": w},
                },
            }
        ]
    }


def transforms_of(message: Any) -> list[Transform]:
    """Return the transforms of a tf2_msgs/TFMessage."""
    from scipy.spatial.transform import Rotation

    found = []
    for transform in message.transforms:
        place, turn = transform.transform.translation, transform.transform.rotation
        quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
        matrix = np.eye(4)
        matrix[:3, 3] = [place.x, place.y, place.z]
        # Translations and quaternions out of range are ignored; they might also overflow.
        if not np.abs(matrix[:3, 3]).max() < _FAR_M or not 1e-3 < np.abs(quaternion).max() < 1e3:
            continue
        matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
        found.append((parent, child, matrix))
    return found
