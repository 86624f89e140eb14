"""OpenNI2's own recorder, which makes the recordings that the tests replay, and what a kill leaves of one."""

from __future__ import annotations

import ctypes
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.openni2.oni import file as oni

_PROTOTYPES: dict[str, tuple[Any, list[Any]]] = {
    "oniCreateRecorder": (ctypes.c_int, [ctypes.c_char_p, ctypes.POINTER(ctypes.c_void_p)]),
    "oniRecorderAttachStream": (ctypes.c_int, [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]),
    "oniRecorderStart": (ctypes.c_int, [ctypes.c_void_p]),
    "oniRecorderStop": (None, [ctypes.c_void_p]),
    "oniRecorderDestroy": (ctypes.c_int, [ctypes.POINTER(ctypes.c_void_p)]),
}
_DATA_BEGIN = 0x08


class RecordedCamera(DeviceSource):
    """A camera that is recorded from its first image on: until `finish`, or until it is closed."""

    def record(self, path: Path, *, lossy: bool = False) -> None:
        """Begin; the recorder must be there before the streams start, or they begin at different moments."""
        self._path, self._handle = path, ctypes.c_void_p()
        library, streams = self._device.library, self._streams
        for name, (result, arguments) in _PROTOTYPES.items():
            function = getattr(library.native, name)
            function.restype, function.argtypes = result, arguments
        for stream in streams:
            stream.stop()
        native = library.native
        library.check(native.oniCreateRecorder(os.fsencode(path), ctypes.byref(self._handle)), "recording")
        for stream in streams:
            attached = native.oniRecorderAttachStream(self._handle, stream.handle, int(lossy))
            library.check(attached, "recording")
        library.check(native.oniRecorderStart(self._handle), "recording")
        deadline_s = time.monotonic() + 5.0
        while not self._has_begun():
            assert time.monotonic() < deadline_s
            time.sleep(0.002)
        for stream in streams:
            stream.start()
        self._device.register(self.metadata["registration"] == "hardware")
        # Images of before are not in the file.
        for images in self._pairing._waiting.values():
            images.clear()

    def _has_begun(self) -> bool:
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            return sum(kind == _DATA_BEGIN for kind, *_ in oni._records(file)) >= len(self._streams)
        return False

    def finish(self) -> None:
        """End the file; while images come, OpenNI2's recorder sometimes waits for itself for good."""
        for stream in self._streams:
            stream.stop()
        native = self._device.library.native
        native.oniRecorderStop(self._handle)
        native.oniRecorderDestroy(ctypes.byref(self._handle))


def record_ten_frames(path: Path) -> bytes:
    """Record a camera; return what the file holds after ten frames, before it gets its end."""
    with RecordedCamera() as source:
        source.record(path)
        for _ in range(10):
            source.read()
        content = path.read_bytes()
        source.finish()
    return content
