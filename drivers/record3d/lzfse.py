"""Decompresses LZFSE into as many bytes as there may be, and no more."""

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import BackendMissingError

_INSTALL = "Record3D's depth is compressed by LZFSE: pip install 'nurbseg[record3d]'"


@cache
def _decoder() -> Any:
    # What the module offers to Python decompresses whatever there is, beginning anew with twice the memory
    # each time it lacks some. Its library's own function fills the memory that it is given.
    try:
        import lzfse

        function = ctypes.CDLL(lzfse.__file__).lzfse_decode_buffer
    except (ImportError, OSError, AttributeError) as err:
        raise BackendMissingError(f"{_INSTALL} ({err})") from err
    function.restype = ctypes.c_size_t
    function.argtypes = [
        ctypes.c_void_p,
        ctypes.c_size_t,
        ctypes.c_char_p,
        ctypes.c_size_t,
        ctypes.c_void_p,
    ]
    return function


def check_installed() -> None:
    """Raise BackendMissingError, which says what to install, if the library is not there."""
    _decoder()


def decompress(content: bytes, most: int) -> NDArray[np.uint8]:
    """Return the (N,) bytes that were compressed; raises ValueError if they are damaged, or over `most`."""
    decompressed = np.empty(most + 1, np.uint8)
    size = _decoder()(decompressed.ctypes.data, decompressed.size, content, len(content), None)
    if size == 0:
        raise ValueError("the LZFSE data are damaged")
    if size > most:
        raise ValueError(f"the LZFSE data hold over {most} bytes")
    return decompressed[:size]
