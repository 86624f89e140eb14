"""Opens and reads files that somebody else made: regular files only, of bounded size."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from nurbseg.drivers.errors import RecordingFormatError


def open_regular(
    path: Path, *, what: str = "recording", error: type[RecordingFormatError] = RecordingFormatError
) -> BinaryIO:
    """Open a regular file for reading; a pipe or device is refused without waiting for it.

    Parameters
    ----------
    path : Path
        The file; a link counts as what it leads to.
    what : str
        What an error calls it.
    error : type
        The error raised.

    Raises
    ------
    RecordingFormatError
        Or what `error` is, if there is no such file, it cannot be opened or is not a regular one.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as err:
        raise error(f"{path}: the {what} cannot be read ({err.strerror})") from err
    except ValueError as err:
        raise error(f"{str(path)!r}: the {what} cannot be read ({err})") from err
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise error(f"{path}: the {what} cannot be read (not a regular file)")
    return os.fdopen(descriptor, "rb")


def read_file(
    path: Path, most: int, *, what: str, error: type[RecordingFormatError] = RecordingFormatError
) -> bytes:
    """Return the content of a regular file of at most `most` bytes.

    Parameters
    ----------
    path, what, error
        As for `open_regular`.
    most : int
        Largest size, bytes.

    Raises
    ------
    RecordingFormatError
        Or what `error` is, as for `open_regular`, or if the file is larger.
    """
    with open_regular(path, what=what, error=error) as stream:
        try:
            size = os.fstat(stream.fileno()).st_size
            if size > most:
                raise error(f"{path}: the {what} has {size} bytes; expected {most} at most")
            return stream.read(most)
        except OSError as err:
            raise error(f"{path}: the {what} cannot be read ({err.strerror})") from err
