"""Opens and reads untrusted files, regular ones of limited size only; creates private ones and folders."""

import errno
import os
import stat
from itertools import count
from pathlib import Path
from typing import BinaryIO

from nurbseg.drivers.errors import RecordingFormatError

#: The first bytes of files, by which they are recognized whatever they are called.
MCAP_MAGIC = b"\x89MCAP0\r\n"
ONI_MAGIC = b"NI10"
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
MATLAB5_MAGIC = b"MATLAB 5.0 MAT-file"
#: MATLAB writes its own 512 bytes before the HDF5 signature.
HDF5_OFFSETS = (0, 512)


def open_regular(
    path: Path, *, what: str = "recording", error: type[RecordingFormatError] = RecordingFormatError
) -> BinaryIO:
    """Open a regular file for reading; a pipe or device is refused without waiting for it.

    Links are followed. Errors are of the given type and call the file `what`. Raises RecordingFormatError or
    what `error` is, if there is no such file, it cannot be opened or is not a regular one.
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

    Raises RecordingFormatError or what `error` is, as for `open_regular`, or if the file is larger.
    """
    with open_regular(path, what=what, error=error) as stream:
        try:
            size = os.fstat(stream.fileno()).st_size
            if size > most:
                raise error(f"{path}: the {what} has {size} bytes; expected {most} at most")
            return stream.read(most)
        except OSError as err:
            raise error(f"{path}: the {what} cannot be read ({err.strerror})") from err


def create_private(path: Path, buffering: int = -1) -> BinaryIO:
    """Create a file that only this user may read, and open it for writing.

    Recordings are private, whatever the umask is. A device is opened as it is. Raises
    FileExistsError if there is a file of this name already, and OSError if it cannot be created.
    """
    check_absent(path)
    new = not path.exists()
    flags = os.O_WRONLY | os.O_CLOEXEC | (os.O_CREAT | os.O_EXCL if new else 0)
    return os.fdopen(os.open(path, flags, 0o600), "wb", buffering)


def check_absent(path: Path) -> None:
    """Raise FileExistsError, whose `strerror` says what to do, if there is a file of this name."""
    if path.is_file() or path.is_symlink():
        raise FileExistsError(errno.EEXIST, "already exists; name another file or remove it", str(path))


def create_folder(path: Path) -> None:
    """Create a folder and its parents, unless it exists; raises ValueError if that is impossible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as err:
        raise ValueError(f"{path}: is a file; a folder is needed") from err
    except OSError as err:
        raise ValueError(f"{path}: cannot be created: {err.strerror}") from err


def part_after(path: Path, parts: int) -> Path:
    """Return the name of the next part of a recording: ``NAME-2.mcap`` after the first.

    Names of existing files are skipped.
    """
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in count(parts + 1))
    return next(each for each in numbered if not each.exists())
