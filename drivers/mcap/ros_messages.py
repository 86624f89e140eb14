"""The ROS 2 messages of a recording: their definitions and names, and their stamps."""

import functools
import struct
from typing import Any

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from nurbseg.common.errors import FrameFormatError, quoted

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"

#: Of our own recordings.
RECORDING_RECORD = "nurbseg"
DEVICE_RECORD = "device"
LABELS_TOPIC = "/camera/labels/image_raw/compressed"
POSE_TOPIC = "/tf"
WORLD_FRAME = "world"

_RULE = "=" * 80
_TIME = f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_VECTOR = f"{_RULE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_QUATERNION = f"{_RULE}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
_HEADER = f"{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
#: The message definitions as a recording states them.
DEFINITIONS = {
    IMAGE: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    f"uint32 step\nuint8[] data\n{_HEADER}",
    COMPRESSED_IMAGE: f"std_msgs/Header header\nstring format\nuint8[] data\n{_HEADER}",
    CAMERA_INFO: "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
    "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
    f"sensor_msgs/RegionOfInterest roi\n{_HEADER}{_RULE}\nMSG: sensor_msgs/RegionOfInterest\n"
    "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n"
    f"{_RULE}\nMSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    f"geometry_msgs/Transform transform\n{_RULE}\nMSG: geometry_msgs/Transform\n"
    f"geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n{_VECTOR}{_QUATERNION}{_HEADER}",
    IMU: "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
    f"{_VECTOR}{_QUATERNION}{_HEADER}",
}


@functools.cache
def _decoder(name: str) -> Any:
    schema = Schema(id=1, name=name, encoding="ros2msg", data=DEFINITIONS[name].encode())
    return DecoderFactory().decoder_for("cdr", schema)


def decode(content: bytes, schema: str, name: str) -> Any:
    """Decode a message by the definition of its schema here, whatever the recording says of it.

    Raises FrameFormatError if the message is damaged; calls it `name`.
    """
    try:
        return _decoder(schema)(content)
    except Exception as err:  # The decoder raises whatever a damaged message leads it to.
        raise FrameFormatError(f"{name}: the message is damaged ({quoted(str(err))})") from err


def stamp_ns(content: bytes) -> int:
    """Return the stamp of a message that begins with a header, without decoding it, nanoseconds."""
    order: Any = "little" if content[1] & 1 else "big"
    seconds = int.from_bytes(content[4:8], order, signed=True)
    return seconds * 1_000_000_000 + int.from_bytes(content[8:12], order)


def restamped(content: bytes, time_ns: int) -> bytes:
    """Return a message that begins with a header with another stamp; raises struct.error if out of range."""
    order = "<" if content[1] & 1 else ">"
    return content[:4] + struct.pack(f"{order}iI", *divmod(time_ns, 1_000_000_000)) + content[12:]
