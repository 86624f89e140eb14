"""Says what a recording holds, and how it would be replayed."""

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.common.errors import (
    CalibrationError,
    DriverError,
    EndOfRecordingError,
    FrameFormatError,
    named,
    printable,
)
from nurbseg.common.files import MCAP_MAGIC, ROSBAG_MAGIC, SQLITE_MAGIC, open_regular
from nurbseg.drivers.calibration.cameras import calibration_table
from nurbseg.drivers.mcap.container.parts import bag_files
from nurbseg.drivers.mcap.scan import Stream, list_streams
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source

#: Frames that are read for their rate and the findings on their stamps.
_FRAMES = 60
#: Longest wait for one of them, seconds.
_FRAME_S = 30.0
#: Focal lengths and principal point of a camera that nothing depends on.
_ANY_CAMERA = (500.0, 500.0, 0.0, 0.0)


@dataclass(slots=True)
class Info:
    """What a recording holds, as ``nurbseg-record info --json`` prints it."""

    file: str
    format: str = ""
    #: Why it cannot be replayed; empty if it can.
    error: str = ""
    streams: list[Stream] = field(default_factory=list)
    #: What is known of the device and the recording, and how it is replayed.
    metadata: dict[str, str] = field(default_factory=dict)
    depth_unit: str = ""
    #: Width and height of the first images, pixels.
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    registered: bool | None = None
    #: Distance of the two cameras, meters.
    baseline_m: float = 0.0
    #: Frames per second by the stamps of the first frames; 0 if unknown.
    rate_hz: float = 0.0
    stamps: list[str] = field(default_factory=list)


def inform(path: Path, options: SourceOptions | None = None) -> Info:
    """Return what a recording of any kind holds; raises DriverError if it is none."""
    found = Info(str(path))
    if _has_streams(path):
        found.format = "MCAP recording"
        found.streams = list_streams(path)
    try:
        _open(path, options, found)
    except CalibrationError as err:
        found.error = str(err)
        if not found.streams:
            # What there is can be listed by any camera.
            with _unsaid(logging.getLogger("nurbseg.drivers.calibration.cameras")):
                _open(path, replace(options or SourceOptions(), intrinsics=_ANY_CAMERA), found)
            found.calibration, found.registered = {}, None
        if "--" in found.error:
            found.error += "; these are flags of nurbseg-live, nurbseg-batch and nurbseg-eval"
    except DriverError as err:
        if not found.streams:
            raise
        found.error = str(err)
    return found


@contextmanager
def _unsaid(log: logging.Logger) -> Iterator[None]:
    """Leave out the warnings of a log while the block runs."""
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


def _has_streams(path: Path) -> bool:
    if path.is_dir():
        return bool(bag_files(path))
    with suppress(DriverError), open_regular(path) as stream:
        return stream.read(len(SQLITE_MAGIC)).startswith((MCAP_MAGIC, ROSBAG_MAGIC, SQLITE_MAGIC))
    return False


def _open(path: Path, options: SourceOptions | None, found: Info) -> None:
    with open_source(path, options) as source:
        stamps: list[int] = []
        calibration = source.calibration
        for _ in range(_FRAMES):
            try:
                frame = source.read(_FRAME_S)
            except FrameFormatError:
                continue
            except EndOfRecordingError:
                break
            if not stamps:
                calibration = frame.calibration
                images = (("depth", frame.depth_mm), ("color", frame.color))
                found.sizes = {name: (image.shape[1], image.shape[0]) for name, image in images}
            stamps.append(frame.timestamp_ns)
        found.metadata = dict(source.metadata)
        found.format = found.metadata.get("format", found.format)
        found.depth_unit = "" if source.depth_unit is None else str(source.depth_unit)
        found.stamps = stamp_findings(stamps, found.metadata)
        found.calibration = calibration_table(calibration)
        found.registered = calibration.is_registered
        found.baseline_m = round(float(np.linalg.norm(calibration.color_from_depth[:3, 3])), 6)
        steps_s = np.diff(np.array(stamps, np.int64)) * 1e-9
        if steps_s.size and (usual_s := float(np.median(steps_s))) > 0:
            found.rate_hz = round(1 / usual_s, 2)


def _camera_text(camera: dict[str, Any]) -> str:
    distorted = ", distorted" if any(camera["distortion"]) else ""
    values = " ".join(f"{name} {camera[name]:.2f}" for name in ("fx", "fy", "cx", "cy"))
    return f"{camera['width']}x{camera['height']} {values}{distorted}"


def as_text(found: Info) -> str:
    """Return it for a person."""
    return printable(os.linesep.join(_lines(found)))


def _lines(found: Info) -> Iterator[str]:
    frames = found.metadata.get("frames")
    counted = f", {frames} frames" if frames else ""
    rate = f", {found.rate_hz:g} frames/s" if found.rate_hz else ""
    yield f"{found.file}: {found.format or 'recording'}{counted}{rate}"
    for stream in found.streams:
        chosen = [name for name in ("depth", "color") if found.metadata.get(f"{name}_topic") == stream.topic]
        size = f" {stream.width}x{stream.height}" if stream.width else ""
        frame = f", frame {named(stream.frame)}" if stream.frame else ""
        rate = f", {stream.rate_hz:g}/s" if stream.rate_hz else ""
        mark = f"  <- {chosen[0]}" if chosen else ""
        form = named(f"{stream.schema} {stream.encoding}".rstrip())
        yield f"  {named(stream.topic)}: {form}{size}{frame}, {stream.messages} messages{rate}{mark}"
    if found.error:
        yield f"  cannot be replayed: {found.error.removeprefix(f'{found.file}: ')}"
        if not found.depth_unit:
            return
        for name, (width, height) in found.sizes.items():
            yield f"  {name} images: {width}x{height}"
    yield f"  depth unit: {found.depth_unit or 'millimeters'}"
    for name in ("depth", "color") if found.calibration else ():
        yield f"  {name} camera: {_camera_text(found.calibration[name])}"
    if found.calibration:
        apart = "registered" if found.registered else f"two cameras, {1000 * found.baseline_m:.1f} mm apart"
        source = found.metadata.get("calibration", "")
        yield f"  images: {apart}{f' (calibration: {source})' if source else ''}"
    if clock := found.metadata.get("clock"):
        yield f"  time: {clock}"
    yield from (f"  stamps: {stamp}" for stamp in found.stamps if stamp != found.metadata.get("clock"))


#: A longer time between two frames is a jump of the clock, seconds.
LONGEST_STEP_S = 10.0


def stamp_findings(stamps_ns: Sequence[int], metadata: Mapping[str, str]) -> list[str]:
    """Return what a person should know of the times of all frames, nanoseconds, and of a source's clocks."""
    found = []
    if "(" in (clock := metadata.get("clock", "")):
        found.append(clock)
    if order := metadata.get("order", ""):
        found.append(order)
    if replaced := int(metadata.get("stamps_replaced", 0)):
        found.append(f"{replaced} wrong (0, out of range or far from the others), the log's times instead")
    steps_s = np.diff(np.array(stamps_ns, dtype=np.int64)).astype(np.float64) * 1e-9
    for name, places, amounts_s in (
        ("go back", np.flatnonzero(steps_s < 0), -steps_s),
        ("jump forward", np.flatnonzero(steps_s > LONGEST_STEP_S), steps_s),
    ):
        if places.size:
            largest = places[np.argmax(amounts_s[places])]
            times = "once" if places.size == 1 else f"{places.size} times"
            found.append(f"they {name} {times}, by up to {amounts_s[largest]:.3f} s, after frame {largest}")
    if repeated := int(np.count_nonzero(steps_s == 0)):
        found.append(f"{repeated} frames have the stamp of the one before")
    return found
