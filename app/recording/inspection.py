"""Says what a recording holds, how it would be replayed, and what is wrong with it."""

import logging
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.common.errors import CalibrationError, DriverError, named, printable
from nurbseg.common.files import MCAP_MAGIC, ROSBAG_MAGIC, SQLITE_MAGIC, open_regular
from nurbseg.drivers.calibration.cameras import calibration_table
from nurbseg.drivers.mcap.container.parts import bag_files
from nurbseg.drivers.mcap.scan import Stream, list_streams
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source

#: Frames that `inform` reads for their rate and the findings on their stamps.
_FRAMES = 60
#: Focal lengths and principal point of a camera that nothing depends on.
_ANY_CAMERA = (500.0, 500.0, 0.0, 0.0)
#: A longer time between two frames is a jump of the clock, seconds.
_LONGEST_STEP_S = 10.0
#: Minimum length of a gap between frames, as a multiple of the usual period.
_GAP_STEPS = 1.5


@dataclass(slots=True)
class Inspection:
    """The contents and state of a recording, as ``nurbseg-record --json`` prints them."""

    file: str
    format: str = ""
    #: Number of readable frames, and their first and last timestamps; of `inform`, 0 if it is not stated.
    frames: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    #: Usual number of frames per second; 0 if unknown.
    rate_hz: float = 0.0
    #: The frame before each gap, counted from 0, and the gap's length, seconds.
    gaps: list[tuple[int, float]] = field(default_factory=list)
    #: What is wrong with the stamps.
    stamps: list[str] = field(default_factory=list)
    #: Why it cannot be replayed; empty if it can.
    error: str = ""
    streams: list[Stream] = field(default_factory=list)
    #: Properties of the device and the recording, and how it is replayed.
    metadata: dict[str, str] = field(default_factory=dict)
    depth_unit: str = ""
    #: Width and height of the first images, pixels.
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    registered: bool | None = None
    #: Distance of the two cameras, meters.
    baseline_m: float = 0.0
    #: Whether it was closed properly.
    end_written: bool = True
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    #: Whether there are no problems; None if it was not read to its end.
    whole: bool | None = None

    def as_text(self) -> str:
        """Return it for a person."""
        state = self.format or "recording"
        if self.whole is not None:
            state = "whole" if self.whole else "NOT whole"
        frames = f", {self.frames} frame{'s' * (self.frames != 1)}"
        counted = frames if self.frames or self.whole is not None else ""
        rate = f", {self.rate_hz:g} frames/s" if self.rate_hz else ""
        details = self._description() if self.whole is None else self._state()
        return printable(os.linesep.join([f"{self.file}: {state}{counted}{rate}", *details]))

    def _description(self) -> Iterator[str]:
        chosen = {self.metadata.get(f"{name}_topic"): f"  <- {name}" for name in ("color", "depth")}
        for stream in self.streams:
            size = f" {stream.width}x{stream.height}" if stream.width else ""
            frame = f", frame {named(stream.frame)}" if stream.frame else ""
            rate = f", {stream.rate_hz:g}/s" if stream.rate_hz else ""
            form = named(f"{stream.schema} {stream.encoding}".rstrip())
            counted = f"{stream.messages} messages{rate}{chosen.get(stream.topic, '')}"
            yield f"  {named(stream.topic)}: {form}{size}{frame}, {counted}"
        if self.error:
            yield f"  cannot be replayed: {self.error.removeprefix(f'{self.file}: ')}"
            yield from (f"  {name} images: {size[0]}x{size[1]}" for name, size in self.sizes.items())
        if not self.error or self.depth_unit:
            yield f"  depth unit: {self.depth_unit or 'millimeters'}"
        for name in ("depth", "color") if self.calibration else ():
            camera = self.calibration[name]
            distorted = ", distorted" if any(camera["distortion"]) else ""
            values = " ".join(f"{key} {camera[key]:.2f}" for key in ("fx", "fy", "cx", "cy"))
            yield f"  {name} camera: {camera['width']}x{camera['height']} {values}{distorted}"
        if self.calibration:
            apart = "registered" if self.registered else f"two cameras, {1000 * self.baseline_m:.1f} mm apart"
            source = self.metadata.get("calibration", "")
            yield f"  images: {apart}{f' (calibration: {source})' if source else ''}"
        clock = self.metadata.get("clock")
        if clock:
            yield f"  time: {clock}"
        yield from (f"  stamps: {stamp}" for stamp in self.stamps if stamp != clock)

    def _state(self) -> Iterator[str]:
        if self.first_ns is not None and self.last_ns is not None:
            span_s = (self.last_ns - self.first_ns) * 1e-9
            yield f"  last frame: {span_s:.3f} s after the first, stamp {self.last_ns * 1e-9:.6f} s"
        if self.gaps:
            frame, longest_s = max(self.gaps, key=lambda gap: gap[1])
            yield f"  gaps: {len(self.gaps)}, the longest {longest_s:.3f} s, after frame {frame}"
        for name, lines in (("stamps", self.stamps), ("wrong", self.problems), ("note", self.remarks)):
            yield from (f"  {name}: {line}" for line in lines)
        if not self.whole and self.format == "MCAP recording" and Path(self.file).is_file():
            yield f"  to repair it: nurbseg-record repair {shlex.quote(self.file)}"


def inform(path: Path, options: SourceOptions) -> Inspection:
    """Return the contents of a recording of any kind; raises DriverError if it is none."""
    found = Inspection(str(path))
    if _has_streams(path):
        found.format = "MCAP recording"
        found.streams = list_streams(path)
    try:
        _read(path, options, found, _FRAMES)
    except DriverError as err:
        found.error = str(err)
        if found.streams:
            return found
        if not isinstance(err, CalibrationError):
            raise
        # The images can be listed with any camera, whose implausible values are nobody's.
        logging.disable()
        try:
            _read(path, replace(options, intrinsics=_ANY_CAMERA), found, _FRAMES)
        finally:
            logging.disable(logging.NOTSET)
        found.calibration, found.registered = {}, None
    found.frames = int(found.metadata.get("frames", 0))
    return found


def inspect(path: Path, options: SourceOptions | None = None) -> Inspection:
    """Read a recording of any kind completely and check it; raises DriverError if nothing can be read."""
    found = Inspection(str(path))
    damaged = _read(path, options, found)
    found.end_written = found.metadata.get("whole") != "false"
    if not found.end_written:
        found.problems.append("it was not closed properly: the recorder was killed, or the disk was full")
    if damaged:
        found.problems.append(f"{len(damaged)} damaged: {damaged[0]}")
    if dropped := int(found.metadata.get("dropped", 0)):
        lost = f"images without a partner, which are in no frame: {dropped}"
        (found.problems if dropped > found.frames else found.remarks).append(lost)
    if lost_labels := found.metadata.get("labels_lost"):
        found.remarks.append(f"labels that cannot be used: {lost_labels}")
    if not found.frames:
        found.problems.append("it contains no frames")
    found.whole = not found.problems
    return found


def _has_streams(path: Path) -> bool:
    if path.is_dir():
        return bool(bag_files(path))
    with suppress(DriverError), open_regular(path) as stream:
        return stream.read(len(SQLITE_MAGIC)).startswith((MCAP_MAGIC, ROSBAG_MAGIC, SQLITE_MAGIC))
    return False


def _read(path: Path, options: SourceOptions | None, found: Inspection, most: int | None = None) -> list[str]:
    """Read all frames, or the first ones, for an inspection; return the errors of damaged ones."""
    damaged: list[str] = []
    stamps: list[int] = []
    with open_source(path, options) as source:
        calibration = source.calibration
        for frame in islice(source.frames(lambda err: damaged.append(str(err))), most):
            if not stamps:
                calibration = frame.calibration
                images = (("depth", frame.depth_mm), ("color", frame.color))
                found.sizes = {name: (image.shape[1], image.shape[0]) for name, image in images}
            stamps.append(frame.timestamp_ns)
        found.metadata = dict(source.metadata)
        found.depth_unit = "" if source.depth_unit is None else str(source.depth_unit)
    found.format = found.metadata.get("format", found.format)
    found.calibration = calibration_table(calibration)
    found.registered = calibration.is_registered
    found.baseline_m = round(float(np.linalg.norm(calibration.color_from_depth[:3, 3])), 6)
    found.stamps = stamp_findings(stamps, found.metadata)
    found.frames = len(stamps)
    if stamps:
        found.first_ns, found.last_ns = stamps[0], stamps[-1]
    steps_s = _steps_s(stamps)
    if steps_s.size and (usual_s := float(np.median(steps_s))) > 0:
        found.rate_hz = round(1 / usual_s, 2)
        after = np.flatnonzero(steps_s > _GAP_STEPS * usual_s)
        found.gaps = [(int(frame), round(float(steps_s[frame]), 3)) for frame in after]
    return damaged


def _steps_s(stamps_ns: Sequence[int]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.diff(np.array(stamps_ns, dtype=np.int64)).astype(np.float64) * 1e-9


def stamp_findings(stamps_ns: Sequence[int], metadata: Mapping[str, str]) -> list[str]:
    """Return what is unusual about the times of all frames, nanoseconds, and about a source's clocks."""
    found = [clock] if "(" in (clock := metadata.get("clock", "")) else []
    steps_s = _steps_s(stamps_ns)
    for name, places, amounts_s in (
        ("go back", np.flatnonzero(steps_s < 0), -steps_s),
        ("jump forward", np.flatnonzero(steps_s > _LONGEST_STEP_S), steps_s),
    ):
        if places.size:
            largest = places[np.argmax(amounts_s[places])]
            times = "once" if places.size == 1 else f"{places.size} times"
            found.append(f"they {name} {times}, by up to {amounts_s[largest]:.3f} s, after frame {largest}")
    if repeated := int(np.count_nonzero(steps_s == 0)):
        found.append(f"{repeated} frames have the stamp of the one before")
    return found
