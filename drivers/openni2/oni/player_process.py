"""The other end of `nurbseg.drivers.openni2.oni.player`: starts it, and bounds every wait for it."""

from __future__ import annotations

import os
import select
import subprocess
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.errors import RecordingFormatError
from nurbseg.drivers.openni2.oni.player import COLOR_IMAGE, END, MESSAGE
from nurbseg.drivers.process.start import python_command

#: The player must say what it plays within this time, seconds; starting Python is most of it.
OPEN_LIMIT_S = 30.0
#: And must hand over an image within this time, seconds, or it hangs.
_HANG_LIMIT_S = 10.0
_LARGEST_BODY = 1 << 27


class Message(NamedTuple):
    """What the player sends: an image's number, time, (height, width, channels) and pixels, or words."""

    kind: int
    number: int
    timestamp_us: int
    shape: tuple[int, int, int]
    body: bytes

    @property
    def image(self) -> NDArray[Any]:
        """The pixels: depth (H, W) uint16 in the recording's unit, color (H, W, 3) uint8 RGB."""
        height, width, channels = self.shape
        if self.kind == COLOR_IMAGE:
            return np.frombuffer(self.body, np.uint8).reshape(height, width, channels)
        return np.frombuffer(self.body, np.uint16).reshape(height, width)


class PlayerProcess:
    """The process that plays a file, and the pipe from it.

    Parameters
    ----------
    path : Path
        The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        command = python_command("nurbseg.drivers.openni2.oni.player", str(path.absolute()))
        self._process = subprocess.Popen(  # its own errors come as messages, its driver's chatter is dropped
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            # Ctrl-C is for this process, which ends the other in its own time.
            start_new_session=True,
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout
        self._descriptor = self._pipe.fileno()
        self._buffer = bytearray()
        self._silent_s = 0.0

    def receive(self, timeout_s: float, limit_s: float | None = None) -> Message | None:
        """Return the next message, or None if it does not come in time.

        Raises
        ------
        RecordingFormatError
            If the player has died, or has said nothing for `limit_s` in all.
        """
        limit_s = _HANG_LIMIT_S if limit_s is None else limit_s
        head = self._fill(MESSAGE.size, timeout_s, limit_s)
        if not head:
            return None
        kind, number, timestamp_us, *shape, size = MESSAGE.unpack(self._buffer[: MESSAGE.size])
        if kind > END or size > _LARGEST_BODY:
            raise RecordingFormatError(f"{self._path}: OpenNI2's file driver sends nonsense")
        if not self._fill(MESSAGE.size + size, timeout_s, limit_s):
            return None
        body = bytes(memoryview(self._buffer)[MESSAGE.size : MESSAGE.size + size])
        del self._buffer[: MESSAGE.size + size]
        return Message(kind, number, timestamp_us, (shape[0], shape[1], shape[2]), body)

    def _fill(self, size: int, timeout_s: float, limit_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        while len(self._buffer) < size:
            begun = time.monotonic()
            ready, _, _ = select.select([self._descriptor], [], [], max(0.0, deadline - begun))
            if not ready:
                self._silent_s += time.monotonic() - begun
                if self._silent_s >= limit_s:
                    raise RecordingFormatError(
                        f"{self._path}: OpenNI2's file driver hangs on it; the file is damaged"
                    )
                return False
            self._silent_s = 0.0
            part = os.read(self._descriptor, max(1 << 16, size - len(self._buffer)))
            if not part:
                code = self._process.wait(timeout=OPEN_LIMIT_S)
                raise RecordingFormatError(
                    f"{self._path}: OpenNI2's file driver stopped with code {code}; the file is damaged"
                )
            self._buffer += part
        return True

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._pipe.close()
        self._process.wait(timeout=OPEN_LIMIT_S)
