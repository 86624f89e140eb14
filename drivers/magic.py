"""The first bytes of the files that are read, by which they are recognised whatever they are called."""

from __future__ import annotations

MCAP = b"\x89MCAP0\r\n"
ONI = b"NI10"
HDF5 = b"\x89HDF\r\n\x1a\n"
MATLAB5 = b"MATLAB 5.0 MAT-file"
#: MATLAB writes its own 512 bytes before the HDF5 signature.
HDF5_OFFSETS = (0, 512)
