"""A camera that is read by a process of its own, as a source of frames."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import mmap
import os
import select
import subprocess
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nurbseg.drivers import errors
from nurbseg.drivers.errors import DeviceLostError, DriverError, FrameTimeoutError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.openni2.isolated.ring import Ring, slot_bytes
from nurbseg.drivers.openni2.oni.calibration_note import calibration_of_note
from nurbseg.drivers.openni2.options import DeviceOptions, parse_mode
from nurbseg.drivers.process.start import python_command
from nurbseg.drivers.source import FrameSource

#: The process must have opened the camera within this time, seconds.
_OPEN_LIMIT_S = 60.0
#: And must answer a command, and end when it is told to, finishing a recording first.
_ANSWER_LIMIT_S = 30.0
#: It says itself when the camera is silent; if even that does not come, the driver hangs.
_HANG_MARGIN_S = 7.0
#: Frames that may wait, seconds.
_DEPTH_S = 1.0
#: Slots are given back in bunches, since each word costs a turn at Python's lock.
_BUNCH = 4


class IsolatedCamera(FrameSource):
    """Frames of a camera, read as `DeviceSource` does, but by another process.

    Up to a second of frames waits here for a reader that comes late.

    Parameters
    ----------
    wanted : str
        Which camera, as `nurbseg.drivers.openni2.selection.choose` reads it.
    options : DeviceOptions, optional
        Its settings.
    pairing_limit_s : float
        Largest difference between the times of a depth image and its color image, seconds.
    patience_s : float, optional
        Where the camera is not there, let the process look for it at this interval, seconds. The
        source is usable once `is_open` says so.

    Attributes
    ----------
    missed : int
        Frames that the camera delivered, but that were too late or too many for us.
    half_pairs : int
        Images whose other half never came.

    Raises
    ------
    BackendMissingError
        If OpenNI2 is not installed.
    DeviceNotFoundError
        If there is no such camera, or it cannot be opened.
    CalibrationError
        If the options name a calibration file that is damaged.
    DriverError
        If the camera has no such streams or modes.
    """

    live = True

    def __init__(
        self,
        wanted: str = "any",
        options: DeviceOptions | None = None,
        *,
        pairing_limit_s: float = 0.02,
        patience_s: float | None = None,
    ) -> None:
        super().__init__()
        self.missed = self.half_pairs = 0
        self._options = options or DeviceOptions()
        self._index = 0
        self._begun = False
        self._buffer = b""
        self._frames: deque[dict[str, Any]] = deque()
        self._used: list[int] = []
        self._silent_s = 0.0
        self._failure: DriverError | None = None
        depth, color = parse_mode(self._options.depth_mode), parse_mode(self._options.color_mode)
        slots = max(4, round(max(depth[2], color[2]) * _DEPTH_S) + _BUNCH)
        asked = {
            "wanted": wanted,
            "options": dataclasses.asdict(self._options),
            "pairing_limit_s": pairing_limit_s,
            "patience_s": patience_s,
            "log_level": logging.getLogger("nurbseg.drivers").getEffectiveLevel(),
            "slots": slots,
            "depth_size": depth[:2],
            "color_size": color[:2],
        }
        descriptor = os.memfd_create("nurbseg-camera")
        try:
            os.ftruncate(descriptor, slots * slot_bytes(depth[:2], color[:2]))
            self._ring = Ring(mmap.mmap(descriptor, 0), depth[:2], color[:2])
            self._process = subprocess.Popen(
                python_command(
                    "nurbseg.drivers.openni2.isolated.program", json.dumps(asked | {"ring": descriptor})
                ),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                pass_fds=[descriptor],
                # Ctrl-C is for this process, which ends the other in its own time.
                start_new_session=True,
            )
        finally:
            os.close(descriptor)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._words, self._answers = self._process.stdin, self._process.stdout
        self._is_open = False
        self._heard_s = time.monotonic()
        if patience_s is None:
            self._wait_until_open()

    def _wait_until_open(self) -> None:
        deadline = time.monotonic() + _OPEN_LIMIT_S
        try:
            while not self.is_open(deadline - time.monotonic()):
                if time.monotonic() >= deadline:
                    raise DeviceLostError(f"OpenNI2 has opened no camera after {_OPEN_LIMIT_S:g} s")
        except BaseException:
            self.close()
            raise

    def is_open(self, timeout_s: float = 0.0) -> bool:
        """Whether the camera is open; waits at most so long for news.

        Raises
        ------
        DriverError
            As on opening.
        """
        for line in [] if self._is_open else self._lines(timeout_s):
            if "opened" in line:
                self.metadata.update(line["opened"])
                self.calibration = calibration_of_note(Path("the camera"), line["calibration"])
                self._is_open = True
        if not self._is_open and time.monotonic() - self._heard_s > _OPEN_LIMIT_S:
            # A process that looks for its camera says so each time that it does not find it.
            self._failure = self._failure or DeviceLostError("OpenNI2 opens no camera; its driver hangs")
        if not self._is_open and self._failure is not None:
            raise self._failure
        return self._is_open

    @property
    def losses(self) -> Mapping[str, int]:
        """Frames that were too late or too many for us, and images whose other half never came."""
        return {"missed": self.missed, "half_pairs": self.half_pairs}

    def start_recording(self, path: Path, *, lossy: bool = False) -> None:
        """Record with OpenNI2's recorder, as `DeviceSource.start_recording` does.

        Raises
        ------
        DriverError
            If it cannot be recorded to, or a recording is being made already.
        DeviceLostError
            If the camera is gone.
        """
        self._tell(record=str(path.absolute()), lossy=lossy)
        self._wait_for("done", _ANSWER_LIMIT_S)

    def stop_recording(self) -> None:
        """Finish the recording, if there is one.

        Raises
        ------
        RecordingFormatError
            If the file could not be finished.
        """
        self._tell(stop=True)
        self._wait_for("done", _ANSWER_LIMIT_S)

    def _tell(self, **command: Any) -> None:
        try:
            self._words.write(json.dumps(command).encode() + b"\n")
            self._words.flush()
        except BrokenPipeError:
            # Why it ended is among the lines that it wrote before.
            return

    def _wait_for(self, key: str, limit_s: float) -> dict[str, Any]:
        deadline = time.monotonic() + limit_s
        while True:
            for line in self._lines(deadline - time.monotonic()):
                if key in line:
                    return line
                if "failed" in line:
                    raise _error(line["failed"], line["text"])
            if self._failure is not None:
                raise self._failure
            if time.monotonic() >= deadline:
                raise DeviceLostError(f"OpenNI2 does not answer within {limit_s:g} s; its driver hangs")

    def _lines(self, timeout_s: float) -> list[dict[str, Any]]:
        """Return the answers that came, waiting for one at most so long; frames and log lines are kept."""
        ready, _, _ = select.select([self._answers], [], [], max(0.0, timeout_s))
        if not ready:
            return []
        part = os.read(self._answers.fileno(), 1 << 16)
        self._heard_s = time.monotonic()
        if not part and self._failure is None:
            code = self._process.wait(_ANSWER_LIMIT_S)
            self._failure = DeviceLostError(f"OpenNI2's driver stopped the camera's process, code {code}")
        *whole, self._buffer = (self._buffer + part).split(b"\n")
        others = []
        for words in map(json.loads, whole):
            if "slot" in words:
                self._frames.append(words)
            elif "log" in words:
                logging.getLogger(words["logger"]).log(words["log"], "%s", words["text"])
            elif "error" in words:
                self._failure = _error(words["error"], words["text"])
            else:
                others.append(words)
        return others

    def _read(self, timeout_s: float) -> RGBDFrame:
        if not self._begun:
            self._begun = True
            self._tell(begin=True)
        deadline = time.monotonic() + timeout_s
        while not self._frames:
            if self._failure is not None:
                raise self._failure
            begun = time.monotonic()
            self._lines(deadline - begun)
            now = time.monotonic()
            if self._frames or self._failure is not None:
                continue
            self._silent_s += now - begun
            if self._silent_s > self._options.silence_limit_s + _HANG_MARGIN_S:
                self._failure = DeviceLostError(f"{self.metadata['device']}: its driver hangs")
            elif now >= deadline:
                raise FrameTimeoutError(
                    f"{self.metadata['device']}: no depth and color within {timeout_s:g} s"
                )
        self._silent_s = 0.0
        words = self._frames.popleft()
        depth_mm, color = self._ring.take(words["slot"])
        self._give_back(words["slot"])
        self.missed, self.half_pairs = words["missed"], words["half_pairs"]
        frame = RGBDFrame(
            index=self._index,
            timestamp_ns=words["timestamp_ns"],
            depth_mm=depth_mm,
            color=color,
            calibration=self.calibration,
        )
        self._index += 1
        return frame

    def _give_back(self, slot: int) -> None:
        self._used.append(slot)
        if len(self._used) >= _BUNCH:
            self._tell(free=self._used)
            self._used = []

    def _close(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            # The end of its words tells the process to end.
            self._words.close()
        try:
            self._drain()
        finally:
            if self._process.poll() is None:
                self._process.kill()
            self._process.wait(_ANSWER_LIMIT_S)
            self._answers.close()

    def _drain(self) -> None:
        """Let the process say its last words, which it may have to before it can end."""
        limit_s = _ANSWER_LIMIT_S if self._failure is None else 2.0
        deadline = time.monotonic() + limit_s
        while time.monotonic() < deadline and self._process.poll() is None:
            self._lines(0.05)


def _error(name: str, text: str) -> DriverError:
    kind = getattr(errors, name, DriverError)
    return kind(text) if isinstance(kind, type) and issubclass(kind, DriverError) else DriverError(text)
