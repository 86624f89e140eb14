"""Decodes depth images that image_transport's plugin for compressed depth made."""

import math
import struct

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.drivers.datasets.images import decode_stored

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
        raise FrameFormatError(f"{name}: format: expected depth as PNG or RVL, got {form!r} of another kind")
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
