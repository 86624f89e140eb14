"""Decodes the images in ROS 2 messages."""

import math
import re
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, quoted
from nurbseg.drivers.datasets.images import decode_color, decode_labels, decode_stored
from nurbseg.drivers.mcap.ros_messages import COMPRESSED_IMAGE

DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
LABEL_ENCODINGS = ("mono16", "16UC1", "mono8", "8UC1", "16SC1", "32SC1")
_LABEL_MAX = 65_535
#: Type and channels of a pixel, and OpenCV's conversion to RGB, by encoding.
_PIXELS: dict[str, tuple[type[np.generic], int, int | None]] = {
    "16UC1": (np.uint16, 1, None),
    "mono16": (np.uint16, 1, None),
    "32FC1": (np.float32, 1, None),
    "16SC1": (np.int16, 1, None),
    "32SC1": (np.int32, 1, None),
    "mono8": (np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "8UC1": (np.uint8, 1, None),
    "rgb8": (np.uint8, 3, None),
    "bgr8": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "8UC3": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "8UC4": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "rgb16": (np.uint16, 3, None),
    "bgr16": (np.uint16, 3, cv2.COLOR_BGR2RGB),
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    "nv12": (np.uint8, 1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (np.uint8, 1, cv2.COLOR_YUV2RGB_NV21),
}
#: Below their rows of brightness, these have half as many of color.
_HALF_MORE_ROWS = ("nv12", "nv21")
#: All but those of depth and labels.
COLOR_ENCODINGS = tuple(
    each for each in _PIXELS if each not in ("16UC1", "mono16", "32FC1", "8UC1", "16SC1", "32SC1")
)


def is_16_bit_png(content: bytes) -> bool:
    """Whether an image is a PNG of one channel of 16 bits, which an encoder of colors does not make."""
    return content.startswith(b"\x89PNG") and content[24:26] == b"\x10\0"


def is_compressed_depth(message: Any, topic: str) -> bool:
    """Whether a CompressedImage is of image_transport's plugin for depth."""
    return "compresseddepth" in message.format.lower() or topic.endswith("/compressedDepth")


def raw_depth(message: Any, schema: str, topic: str, name: str) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Return the (H, W) depth of a message in the unit that it has, uint16 or float32.

    Raises FrameFormatError, which calls it `name`, if it is not a whole depth image.
    """
    if schema != COMPRESSED_IMAGE:
        return _pixels(message, DEPTH_ENCODINGS, name)
    content = bytes(message.data)
    if is_compressed_depth(message, topic):
        return decode_compressed_depth(content, message.format, name)
    return decode_stored(content, name)


def color_of(message: Any, schema: str, name: str) -> NDArray[np.uint8]:
    """Return the (H, W, 3) uint8 RGB of a color message; raises FrameFormatError as `raw_depth` does."""
    if schema == COMPRESSED_IMAGE:
        pixels = decode_color(bytes(message.data), name)
        encoding, _, form = message.format.partition(";")
        if not encoding.startswith("bayer_") or encoding not in _PIXELS or re.search("rgb|bgr", form):
            return pixels
        # The plugin compresses the mosaic as if it were gray.
        pixels = np.ascontiguousarray(pixels[..., 0])
    else:
        pixels, encoding = _pixels(message, COLOR_ENCODINGS, name), message.encoding
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    *_, code = _PIXELS[encoding]
    try:
        return np.array(pixels) if code is None else cv2.cvtColor(pixels, code).astype(np.uint8)
    except cv2.error as err:
        # Of an odd width, or too small for a pattern of 2 x 2.
        raise FrameFormatError(f"{name}: {encoding} of {pixels.shape[1]} columns: {err.err}") from err


def size_of(message: Any, schema: str, topic: str, *, is_depth: bool) -> tuple[int, int] | None:
    """Return the width and height of an image that is decoded for it, pixels; None if it is damaged."""
    try:
        shape = (
            raw_depth(message, schema, topic, topic) if is_depth else color_of(message, schema, topic)
        ).shape
    except FrameFormatError:
        return None
    return shape[1], shape[0]


def labels_of(message: Any, schema: str, name: str) -> NDArray[np.uint16]:
    """Return the (H, W) uint16 labels of a message; raises FrameFormatError as `raw_depth` does."""
    if schema == COMPRESSED_IMAGE:
        return decode_labels(bytes(message.data), name)
    labels = _pixels(message, LABEL_ENCODINGS, name)
    if labels.min() < 0 or labels.max() > _LABEL_MAX:
        got = f"{labels.min()} to {labels.max()}"
        raise FrameFormatError(f"{name}: data: expected labels of 0 to {_LABEL_MAX}, got {got}")
    return labels.astype(np.uint16)


def _pixels(message: Any, encodings: tuple[str, ...], name: str) -> NDArray[Any]:
    if message.encoding not in encodings:
        raise FrameFormatError(
            f"{name}: encoding: expected one of {', '.join(encodings)}, got {quoted(message.encoding)}"
        )
    kind, channels, _ = _PIXELS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    row_bytes = message.width * channels * dtype.itemsize
    height = message.height * 3 // 2 if message.encoding in _HALF_MORE_ROWS else message.height
    if not message.width or not message.height:
        raise FrameFormatError(f"{name}: width, height: the image has no pixels")
    if message.step < row_bytes:
        raise FrameFormatError(
            f"{name}: step: expected {row_bytes} bytes or more for {message.width} pixels, got {message.step}"
        )
    if len(message.data) < message.step * (height - 1) + row_bytes:
        raise FrameFormatError(
            f"{name}: data: the image is cut off: {len(message.data)} bytes of {message.step * height}"
        )
    rows = np.ndarray((height, row_bytes), np.uint8, buffer=message.data, strides=(message.step, 1))
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels.reshape(height, message.width, channels)


_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
#: Of the plugin: a format, which is the same for all images, and the two parameters of the quantization.
_HEADER = struct.Struct("<iff")


def decode_compressed_depth(content: bytes, form: str, name: str) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Return the (H, W) depth of a CompressedImage of the format `form`, in the unit of what was compressed.

    Floating-point meters are stored as their inverse, quantized: depth = a / (value - b), with 0 for none. So
    the result is float32 meters where `form` says 32FC1, or neither type but a and b do. Where both are 0 the
    values are not quantized. Other images are uint16. Raises FrameFormatError, which calls the image `name`,
    if it is damaged, or neither PNG nor RVL.
    """
    a = b = 0.0
    if not content.startswith(_PNG_MAGIC):
        if len(content) < _HEADER.size:
            raise FrameFormatError(f"{name}: the compressed depth is cut off after {len(content)} bytes")
        _, a, b = _HEADER.unpack_from(content)
        content = content[_HEADER.size :]
    if content.startswith(_PNG_MAGIC):
        values = decode_stored(content, name)
    elif "rvl" in form.lower():
        from nurbseg.drivers.mcap.decoding.rvl import decode_rvl  # late: its loop is compiled

        values = decode_rvl(content, name)
    else:
        raise FrameFormatError(
            f"{name}: format: expected depth as PNG or RVL, got {quoted(form)} of another kind"
        )
    kind = form.partition(";")[0].strip().upper()
    # The parameters of 16-bit images are not set, and may be anything.
    if kind in ("16UC1", "MONO16") or (a == 0 and b == 0):
        return values
    if not (math.isfinite(a) and math.isfinite(b)) or a <= 0:
        raise FrameFormatError(
            f"{name}: expected a finite quantization a / (value - b), got a = {a:g}, b = {b:g}"
        )
    above = values.astype(np.float32) - np.float32(b)
    is_measured = (values > 0) & (above > 0)
    meters = np.zeros(values.shape, np.float32)
    np.divide(np.float32(a), above, out=meters, where=is_measured)
    return meters
