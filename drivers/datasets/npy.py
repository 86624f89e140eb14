"""Reads arrays that NumPy saved, without running what may be in them."""

import ast
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, quoted
from nurbseg.common.limits import FRAME_BYTES_MAX, PIXELS_MAX

NPY_MAGIC = b"\x93NUMPY"
_HEADER_MAX = 4096


def read_npy(content: bytes, name: str, *, color: bool = False) -> NDArray[Any]:
    """Return the numbers of an array that NumPy saved, without running what may be in it.

    They are (H, W) depth of more than one byte, dimensions of length 1 being dropped, or (H, W, 3) `color` of
    one byte. Raises FrameFormatError, which calls the array `name`, if it is damaged, too large or of another
    form.
    """
    version = content[6] if len(content) > 6 else 0
    start = 10 if version == 1 else 12
    length = int.from_bytes(content[8:start], "little")
    if version not in (1, 2, 3) or length > _HEADER_MAX or len(content) < start + length:
        raise FrameFormatError(f"{name}: the NumPy array is damaged: its header is none")
    try:
        header = ast.literal_eval(content[start : start + length].decode())
        by_columns, shape, dtype = header["fortran_order"], tuple(header["shape"]), np.dtype(header["descr"])
    except (ValueError, SyntaxError, TypeError, KeyError, RecursionError, MemoryError) as err:
        raise FrameFormatError(
            f"{name}: the NumPy array's header cannot be read ({quoted(str(err))})"
        ) from err
    if dtype != np.uint8 if color else dtype.kind not in "iuf" or dtype.itemsize < 2:
        expected = "color of 8 bits, RGB" if color else "depth of 16 bits or floating point"
        raise FrameFormatError(f"{name}: expected {expected}, got an array of {dtype}")
    if not all(isinstance(each, int) and each > 0 for each in shape):
        raise FrameFormatError(f"{name}: expected a shape of whole numbers over 0, got {quoted(shape)}")
    size = shape if color else tuple(each for each in shape if each > 1)
    is_image = len(size) == 3 and size[2] == 3 if color else len(size) == 2
    is_image = is_image and math.prod(size[:2]) <= PIXELS_MAX
    if not is_image or math.prod(size) * dtype.itemsize > FRAME_BYTES_MAX:
        raise FrameFormatError(
            f"{name}: expected one image of {PIXELS_MAX} pixels at most{', (H, W, 3)' if color else ''}, got "
            f"an array of {quoted(shape)}"
        )
    if len(content) - start - length < math.prod(size) * dtype.itemsize:
        raise FrameFormatError(f"{name}: the NumPy array is cut off after {len(content)} bytes")
    values = np.frombuffer(content, dtype, math.prod(size), start + length)
    array = values.reshape(size, order="F" if by_columns else "C")
    # Of 16 bits, floating-point numbers end at 65504.
    kept = np.dtype(np.float32) if dtype.kind == "f" and dtype.itemsize == 2 else dtype.newbyteorder("=")
    return np.ascontiguousarray(array.astype(kept, copy=False))
