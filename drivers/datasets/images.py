"""Decodes color, depth and label images, and reports what is wrong with one that cannot be used.

Pillow reads an image's header, which limits its size, and OpenCV decodes it: it notices damage that Pillow
passes over, and is faster.
"""

import io
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from nurbseg.common.errors import FrameFormatError, quoted
from nurbseg.common.limits import PIXELS_MAX
from nurbseg.drivers.calibration.foreign import HEAD_BYTES, is_image, what_it_is

#: Gray level that stands in for a missing color image.
GRAY = 128
_FORMATS = ("PNG", "JPEG", "TIFF", "PPM", "BMP")
_NOT_READ = (
    "the image is cut off, damaged or of a kind that is not read; save color as 8 bits, and depth as 16 bits "
    "or float32"
)
#: Each scan of a progressive JPEG goes over the whole image; encoders make about ten.
_JPEG_SCANS_MAX = 100
#: Within the coded pixels of a JPEG, FF is followed by 0.
_JPEG_SCAN = b"\xff\xda"


def _checked(content: bytes, name: str) -> tuple[str, str]:
    """Return the format and the mode, as Pillow calls them, of an image that is safe to decode.

    Raises FrameFormatError if it is of no known format, too large or, of a PNG, damaged.
    """
    if not content:
        raise FrameFormatError(f"{name}: the image is empty (0 bytes)")
    try:
        with Image.open(io.BytesIO(content), formats=_FORMATS) as image:
            (width, height), form, mode = image.size, str(image.format), image.mode
            if form == "PNG":
                # OpenCV checks it too, but writes to stderr.
                image.verify()
            if form == "TIFF":
                with suppress(EOFError):
                    image.seek(1)
                    raise FrameFormatError(f"{name}: the TIFF has several images; save each by itself")
    except UnidentifiedImageError as err:
        kind = what_it_is(content[:HEAD_BYTES], Path(name))
        what = f"not an image that can be decoded ({', '.join(_FORMATS)}){f': {kind}' if kind else ''}"
        raise FrameFormatError(f"{name}: {_NOT_READ if is_image(content) else what}") from err
    except Image.DecompressionBombError as err:
        raise FrameFormatError(f"{name}: expected {PIXELS_MAX} pixels at most") from err
    except FrameFormatError:
        raise
    # A damaged file makes Pillow raise errors of many kinds.
    except Exception as err:
        raise FrameFormatError(f"{name}: the image is cut off or damaged ({quoted(str(err))})") from err
    if width * height > PIXELS_MAX:
        raise FrameFormatError(f"{name}: expected {PIXELS_MAX} pixels at most, got {width} x {height}")
    if form == "JPEG" and content.count(_JPEG_SCAN) > _JPEG_SCANS_MAX:
        raise FrameFormatError(f"{name}: the JPEG has more than {_JPEG_SCANS_MAX} scans")
    return form, mode


def decode(content: bytes, flags: int, name: str) -> NDArray[Any]:
    """Decode an image as OpenCV does with these flags; raises FrameFormatError, which calls it `name`."""
    _checked(content, name)
    # OpenCV would also write its own report to stderr.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as err:
        raise FrameFormatError(f"{name}: the image cannot be decoded ({quoted(err.err)})") from err
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise FrameFormatError(f"{name}: {_NOT_READ}")
    return image


def decode_color(content: bytes, name: str) -> NDArray[np.uint8]:
    """Decode a color image to (H, W, 3) uint8 RGB; gray is spread over the three channels.

    Raises FrameFormatError, which calls the image `name`, if it is cut off, damaged or of an unknown form.
    """
    if content.startswith(NPY_MAGIC):
        return read_npy(content, name, color=True)
    bgr = decode(content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, name)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def decode_stored(content: bytes, name: str) -> NDArray[Any]:
    """Decode a depth image to (H, W) whole or floating-point numbers in the unit of the file.

    The file is an image of one channel of 16 or 32 bits, or an array of NumPy's. Raises FrameFormatError,
    which calls the image `name`, if it is cut off, damaged or of another form.
    """
    if content.startswith(NPY_MAGIC):
        return read_npy(content, name)
    image = decode(content, cv2.IMREAD_UNCHANGED, name)
    bits = 8 * image.dtype.itemsize
    if image.ndim == 2 and bits > 8:
        return image
    channels = 1 if image.ndim == 2 else image.shape[2]
    hint = ""
    if bits == 8:
        what = "8 bits are" if channels == 1 else "colors are"
        hint = f"; {what} depth as it is shown, and cannot be converted back: export 16-bit PNG"
    raise FrameFormatError(
        f"{name}: expected a depth image of 1 channel of 16 bits, got {channels} of {bits} bits{hint}"
    )


def decode_labels(content: bytes, name: str) -> NDArray[np.uint16]:
    """Decode a label image of one channel of 8 or 16 bits to (H, W) uint16; of a palette, the indices.

    Raises FrameFormatError if the image is cut off, damaged or has more than one channel.
    """
    form, mode = _checked(content, name)
    if form == "PNG" and mode in ("P", "L", "1"):
        # OpenCV would return the palette's colors.
        with Image.open(io.BytesIO(content), formats=_FORMATS) as image:
            # Two or four bits are spread over the gray levels.
            step = {"L;2": 85, "L;4": 17}.get(str(image.tile[0].args), 1)
            try:
                return np.asarray(image).astype(np.uint16) // np.uint16(step)
            except (OSError, SyntaxError, ValueError) as err:
                raise FrameFormatError(f"{name}: the image is damaged ({quoted(str(err))})") from err
    image_labels = decode(content, cv2.IMREAD_UNCHANGED, name)
    if image_labels.ndim != 2 or image_labels.dtype not in (np.uint8, np.uint16):
        raise FrameFormatError(
            f"{name}: expected labels of 1 channel of 8 or 16 bits, got {image_labels.shape}"
        )
    return image_labels.astype(np.uint16)


NPY_MAGIC = b"\x93NUMPY"
_HEADER_MAX = 4096


def read_npy(content: bytes, name: str, *, color: bool = False) -> NDArray[Any]:
    """Return the numbers of an array that NumPy saved, without running what may be in it.

    They are (H, W) depth of more than one byte, dimensions of length 1 being dropped, or (H, W, 3) `color` of
    one byte. Raises FrameFormatError, which calls the array `name`, if it is damaged, too large or of another
    form.
    """
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False, max_header_size=_HEADER_MAX)
    # A damaged header makes NumPy raise errors of many kinds.
    except Exception as err:
        raise FrameFormatError(f"{name}: the NumPy array cannot be read ({quoted(str(err))})") from err
    shape, dtype = array.shape, array.dtype
    if dtype != np.uint8 if color else dtype.kind not in "iuf" or dtype.itemsize < 2:
        expected = "color of 8 bits, RGB" if color else "depth of 16 bits or floating point"
        raise FrameFormatError(f"{name}: expected {expected}, got an array of {dtype}")
    if not color:
        array = array.squeeze()
    is_image = array.ndim == 3 and array.shape[2] == 3 if color else array.ndim == 2
    if not is_image or not 0 < array.shape[0] * array.shape[1] <= PIXELS_MAX:
        raise FrameFormatError(
            f"{name}: expected one image of {PIXELS_MAX} pixels at most{', (H, W, 3)' if color else ''}, got "
            f"an array of {quoted(shape)}"
        )
    # Of 16 bits, floating-point numbers end at 65504.
    kept = np.dtype(np.float32) if dtype.kind == "f" and dtype.itemsize == 2 else dtype.newbyteorder("=")
    return np.ascontiguousarray(array.astype(kept, copy=False))
