"""Opens untrusted files, regular ones of limited size only; writes files, also JSON, and creates folders.

Files are written where others may have put links: none is followed.
"""

import errno
import io
import json
import logging
import os
import secrets
import select
import shutil
import stat
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from nurbseg.common.errors import RecordingFormatError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_log = logging.getLogger(__name__)

#: Bytes of a JSON file: 16 MiB, a hundred times what a tree takes.
_JSON_BYTES_MAX = 1 << 24
#: Longest wait for the reader of a pipe, and time between two attempts to open it, seconds.
_READER_S, _POLL_S = 10.0, 0.1
#: Characters of a file's name in that of its unfinished version: names have 255 bytes at most.
_NAME_MAX = 50
#: The first bytes of files, by which they are recognized whatever they are called.
MCAP_MAGIC = b"\x89MCAP0\r\n"
ROSBAG_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\0"
ONI_MAGIC = b"NI10"


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


def visible(folder: Path, pattern: str = "*") -> list[Path]:
    """Return the files and folders that match a pattern, by name, without hidden ones.

    macOS leaves a hidden ``._NAME`` beside each file that it copies to a foreign disk or archive.
    """
    return sorted(path for path in folder.glob(pattern) if not path.name.startswith("."))


def with_suffix(folder: Path, suffix: str) -> list[Path]:
    """Return the files and folders of a folder that end in a suffix such as ``.mcap``, in either case."""
    return [path for path in visible(folder) if path.suffix.lower() == suffix]


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

    Recordings are private, whatever the umask is. A pipe or a character device of this user is opened as it
    is; a pipe has ten seconds to be opened by its reader, and either as long to accept each part. Raises
    OSError as `check_absent` does, or if the file cannot be created, or no program reads the pipe.
    """
    check_absent(path)
    if not is_stream(path):
        descriptor = os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_CREAT | os.O_EXCL, 0o600)
        return os.fdopen(descriptor, "wb", buffering)
    stream = _Stream(_open_stream(path), "wb")
    return cast(BinaryIO, io.BufferedWriter(stream) if buffering else stream)


class _Stream(io.FileIO):
    """A pipe or a character device; raises OSError where it accepts nothing for ten seconds."""

    _count = 0

    def tell(self) -> int:
        return self._count

    def write(self, content: "ReadableBuffer", /) -> int:
        room = select.poll()
        room.register(self.fileno(), select.POLLOUT)
        while room.poll(1e3 * _READER_S):
            # None if another program has filled it meanwhile.
            if (count := super().write(content)) is not None:
                self._count += count
                return count
        raise OSError(errno.ETIMEDOUT, f"is a pipe or device that has accepted nothing for {_READER_S:g} s")


def _open_stream(path: Path) -> int:
    """Open a pipe or a character device, which never waits; raises OSError if it is another user's."""
    flags = os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
    deadline_s = time.monotonic() + _READER_S
    said = False
    while True:
        try:
            descriptor = os.open(path, flags)
            break
        except OSError as err:
            if err.errno != errno.ENXIO or not path.is_fifo():
                raise
        if time.monotonic() >= deadline_s:
            reason = f"is a pipe that no program has opened for reading within {_READER_S:g} s"
            raise OSError(errno.ENXIO, reason, str(path))
        if not said:
            said = True
            _log.warning("%s: waiting up to %g s for a program that reads this pipe", path, _READER_S)
        time.sleep(_POLL_S)
    status = os.fstat(descriptor)
    if not _is_stream(status.st_mode) or status.st_uid not in (0, os.geteuid()):
        os.close(descriptor)
        raise FileExistsError(errno.EEXIST, "already exists; name another file", str(path))
    return descriptor


@contextmanager
def replacing(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Write a file under a random name in the block, and rename it after it: it is there completely or not.

    Nobody else can foresee or create that name, and no link is followed, so the folder may be one that others
    can write. `mode` is subject to the umask. A pipe or a character device is not replaced: the content is
    written into it after the block. Raises OSError, which names the file, if it cannot be written; an
    existing file is kept then.
    """
    check_absent(path, force=True)
    if is_stream(path):
        with TemporaryFile() as file:
            yield file
            file.seek(0)
            with create_private(path) as stream:
                shutil.copyfileobj(file, stream)
        return
    temporary = path.with_name(f".{path.name[:_NAME_MAX]}.{secrets.token_hex(8)}.part")
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_CREAT | os.O_EXCL
    try:
        # Opened within: a signal may end the process at any moment.
        try:
            with os.fdopen(os.open(temporary, flags, mode), "w+b") as file:
                yield file
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as err:
        raise OSError(err.errno, err.strerror, str(path)) from err


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file completely or not at all; see `replacing`."""
    with replacing(path) as file:
        file.write(content)


def append(path: Path, content: bytes) -> None:
    """Add to a file that was written before; raises OSError if it is a link, or has been replaced by one."""
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(descriptor, "ab") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
            raise OSError(errno.EMLINK, "has been replaced by something else", str(path))
        file.write(content)


def check_absent(path: Path, *, force: bool = False) -> None:
    """Raise OSError, whose `strerror` says what to do, unless an output may have this name.

    There may be nothing yet, or a pipe or a character device, which is written into. With `force` there may
    be a regular file, or a link to one or to nothing, which is replaced; without, it is a FileExistsError.
    """
    if is_stream(path) or not (path.exists() or path.is_symlink()):
        return
    if path.is_dir():
        raise OSError(errno.EISDIR, "is a folder; name another file", str(path))
    if path.exists() and not path.is_file():
        raise OSError(
            errno.EINVAL, "is no regular file, pipe or character device; name another file", str(path)
        )
    if not force:
        raise FileExistsError(errno.EEXIST, "already exists; name another file or remove it", str(path))


def is_stream(path: Path) -> bool:
    """Whether this is a pipe or a character device, which is neither replaced nor removed; no link to one."""
    try:
        return _is_stream(path.lstat().st_mode)
    except OSError:
        return False


def _is_stream(mode: int) -> bool:
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)


def remove_output(path: Path) -> None:
    """Remove a file, unless it is a pipe or a device, or there is none."""
    if not is_stream(path):
        path.unlink(missing_ok=True)


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


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file as `write_atomically` does."""
    write_atomically(path, (json.dumps(document, indent=1) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file, which anybody may have changed.

    Raises FileNotFoundError if there is none, and ValueError, which names the file, if it is not a regular
    file, too large, or contains no JSON object.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: does not exist")
    content = read_file(path, _JSON_BYTES_MAX, what="file")
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as err:
        raise ValueError(f"{path}: cannot be read: {err}") from err
    if not isinstance(document, dict):
        raise ValueError(f"{path}: cannot be read: expected a JSON object")
    return document
