"""Decodes depth images of the RVL codec: run lengths of zeros, and differences of variable length.

References
----------
.. [1] A. D. Wilson, "Fast lossless depth image compression", ISS 2017.
"""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import U16, compiled
from nurbseg.common.errors import FrameFormatError
from nurbseg.common.limits import PIXELS_MAX

#: Of a number of 32 bits, three in each half byte.
_HALF_BYTES_MAX = 11
_SIZE_BYTES = 8


def decode_rvl(content: bytes, name: str) -> NDArray[np.uint16]:
    """Return the (H, W) uint16 values of an image as image_transport stores it: its size, then the code.

    Raises FrameFormatError, which calls the image `name`, if it is cut off, damaged or too large.
    """
    if len(content) < _SIZE_BYTES:
        raise FrameFormatError(f"{name}: the RVL image is cut off after {len(content)} bytes")
    width, height = (int(each) for each in np.frombuffer(content, "<u4", 2))
    if not width or not height or width * height > PIXELS_MAX:
        raise FrameFormatError(
            f"{name}: width, height: expected 1 to {PIXELS_MAX} pixels in all, got {width} x {height}"
        )
    words = np.frombuffer(content, "<u4", offset=_SIZE_BYTES, count=(len(content) - _SIZE_BYTES) // 4)
    image = np.zeros(width * height, np.uint16)
    decoded = _decode(words.astype(np.uint32), image)
    if decoded != image.size:
        raise FrameFormatError(f"{name}: the RVL image is damaged at pixel {decoded} of {image.size}")
    return image.reshape(height, width)


@compiled
def _decode(words: NDArray[np.uint32], image: U16) -> int:
    """Decode into an image of zeros; return how many pixels were decoded before the code ended or failed."""
    place = 0  # in half bytes, the highest of each word first
    end = 8 * words.size
    pixel = 0
    value = 0
    in_zeros = True
    left = 0
    while pixel < image.size or left > 0:
        number = 0
        length = 0
        while True:
            if place >= end or length >= _HALF_BYTES_MAX:
                return pixel
            half = int(words[place >> 3]) >> (28 - 4 * (place & 7)) & 15
            number |= (half & 7) << (3 * length)
            place += 1
            length += 1
            if not half & 8:
                break
        if left > 0:
            value += (number >> 1) ^ -(number & 1)
            image[pixel] = np.uint16(value & 0xFFFF)
            pixel += 1
            left -= 1
        elif pixel + number > image.size:
            return pixel
        elif in_zeros:
            pixel += number
            in_zeros = False
        else:
            left = number
            in_zeros = True
    return pixel
