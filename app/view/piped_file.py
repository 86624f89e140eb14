"""A file behind a pipe, for a library that cannot handle a full disk."""

import contextlib
import errno
import fcntl
import os
import threading
from pathlib import Path

from nurbseg.common.files import create_private

#: Size of a read, and of the pipe, bytes.
_PART = 1 << 20


class PipedFile:
    """A file behind a pipe, whose content goes to the file, or nowhere after an error.

    Some libraries hang forever if a file cannot be written. This pipe is always read to its end. Open it for
    writing within the ``with`` block; the file ends when the last writer has closed the pipe.

    The file must not exist; its folder is created, and only this user may read it. Raises OSError if it
    cannot be created. `error` is the reason why it could not be written any further.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = create_private(path, buffering=0)
        self._read_end, self._write_end = os.pipe()
        with contextlib.suppress(OSError):
            # Otherwise a writer would wait after every 64 kB.
            fcntl.fcntl(self._write_end, fcntl.F_SETPIPE_SZ, _PART)
        self._thread = threading.Thread(target=self._copy, name=f"view-file-{path.name}")
        self._thread.start()

    def __enter__(self) -> Path:
        """Return a path by which the pipe can be opened for writing."""
        return Path(f"/proc/self/fd/{self._write_end}")

    def __exit__(self, *_: object) -> None:
        os.close(self._write_end)

    def join(self, timeout_s: float) -> bool:
        """Wait for the end of the file; return whether it came within `timeout_s` seconds."""
        self._thread.join(max(0.0, timeout_s))
        return not self._thread.is_alive()

    def _copy(self) -> None:
        while part := memoryview(os.read(self._read_end, _PART)):
            try:
                if self.error is None and os.fstat(self._file.fileno()).st_nlink == 0:
                    raise OSError(errno.ENOENT, "it was deleted while it was written")
                while part and self.error is None:
                    part = part[self._file.write(part) :]
            except OSError as err:
                self.error = err
        os.close(self._read_end)
        try:
            self._file.close()
        except OSError as err:
            self.error = self.error or err
