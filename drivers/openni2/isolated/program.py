"""Reads a camera and hands its frames to another process; a program of its own.

The other process computes, and Python lets only one of its threads run at a time: a thread that reads a
camera there comes too late again and again, and OpenNI2 keeps only the newest image. Here nothing else
runs. A driver that crashes or hangs takes only this process with it, too.

Pixels go through a ring of shared memory, words through pipes, as lines of JSON.
"""

from __future__ import annotations

import contextlib
import json
import logging
import mmap
import os
import queue
import sys
import threading
from collections import deque
from pathlib import Path
from typing import Any, BinaryIO

from nurbseg.drivers.errors import DeviceNotFoundError, DriverError, FrameTimeoutError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.openni2.isolated.ring import Ring
from nurbseg.drivers.openni2.oni.calibration_note import calibration_note
from nurbseg.drivers.openni2.options import DeviceOptions

#: Longest wait for a frame before commands are looked at again, seconds.
_SLICE_S = 0.1


class _Sender(logging.Handler):
    """Writes lines; log records become lines too."""

    def __init__(self, out: BinaryIO) -> None:
        super().__init__(logging.DEBUG)
        self._out = out
        self._writing = threading.Lock()

    def send(self, **words: Any) -> None:
        line = json.dumps(words).encode() + b"\n"
        with self._writing:
            self._out.write(line)
            self._out.flush()

    def emit(self, record: logging.LogRecord) -> None:
        self.send(log=record.levelno, logger=record.name, text=record.getMessage())


class _Commands:
    """Lines from the other process: the slots that are free again, and what else it wants."""

    def __init__(self, lines: BinaryIO, slots: int) -> None:
        self.free = deque(range(slots))
        self.other: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.begun, self.ended = threading.Event(), threading.Event()
        # A daemon: it waits in a read that nothing ends but the other process.
        threading.Thread(target=self._listen, args=(lines,), daemon=True).start()

    def _listen(self, lines: BinaryIO) -> None:
        for line in lines:
            command = json.loads(line)
            if "begin" in command:
                self.begun.set()
            elif "free" in command:
                # In front, so that little of the ring is ever touched.
                self.free.extendleft(command["free"])
            else:
                self.other.put(command)
        self.ended.set()


def _open(asked: dict[str, Any], commands: _Commands, sender: _Sender) -> DeviceSource | None:
    """Open the camera, waiting for it if that is asked; None if nobody wants it any more."""
    options = DeviceOptions(**asked["options"])
    while True:
        try:
            return DeviceSource(asked["wanted"], options, pairing_limit_s=asked["pairing_limit_s"])
        except DeviceNotFoundError:
            if asked["patience_s"] is None:
                raise
        sender.send(away=True)
        if commands.ended.wait(asked["patience_s"]):
            return None


def _deliver(source: DeviceSource, ring: Ring, commands: _Commands, sender: _Sender) -> None:
    lost, before = 0, (0, 0)
    while not commands.ended.is_set():
        while not commands.other.empty():
            _obey(source, commands.other.get(), sender)
        try:
            frame: RGBDFrame = source.read(_SLICE_S)
        except FrameTimeoutError:
            continue
        if not commands.begun.is_set():
            # Nobody reads yet: what is old by then is of no use, and not missed.
            before = source.missed, source.half_pairs
            continue
        if not commands.free:
            lost += 1
            continue
        slot = commands.free.popleft()
        ring.put(slot, frame.depth_mm, frame.color)
        sender.send(
            slot=slot,
            timestamp_ns=frame.timestamp_ns,
            missed=source.missed - before[0] + lost,
            half_pairs=source.half_pairs - before[1],
        )


def _obey(source: DeviceSource, command: dict[str, Any], sender: _Sender) -> None:
    try:
        if "record" in command:
            source.start_recording(Path(command["record"]), lossy=command["lossy"])
        else:
            source.stop_recording()
    except DriverError as err:
        sender.send(failed=type(err).__name__, text=str(err))
    else:
        sender.send(done=True)


def main() -> int:
    """Open the camera that the only argument describes, and deliver its frames."""
    asked = json.loads(sys.argv[1])
    with contextlib.suppress(OSError):  # only some users may; a frame is lost if this is 33 ms late
        os.nice(-10)
    # The library may print: only lines go to where standard output went.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sender = _Sender(out)
    logging.basicConfig(level=asked["log_level"], handlers=[sender])
    commands = _Commands(sys.stdin.buffer, asked["slots"])
    ring = Ring(mmap.mmap(asked["ring"], 0), asked["depth_size"], asked["color_size"])
    try:
        source = _open(asked, commands, sender)
        if source is None:
            return 0
        with source:
            sender.send(opened=source.metadata, calibration=calibration_note(source.calibration))
            _deliver(source, ring, commands, sender)
    except BrokenPipeError:
        # Nobody reads any more, and flushing on the way out would say so again.
        os._exit(0)
    except DriverError as err:
        sender.send(error=type(err).__name__, text=str(err))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
