"""Writes frames of any recording that can be replayed to a new recording, or to a folder of images."""

import logging
import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.recording.inspection import FULL, written
from nurbseg.common.errors import DriverError, FrameFormatError
from nurbseg.common.files import check_absent, remove_output, write_atomically
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.calibration.file import write_calibration
from nurbseg.drivers.mcap.writer import ColorFormat, RecordingWriter
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Converted:
    """What was written, as ``nurbseg-record --json`` prints it; `damaged` frames were left out."""

    file: str
    frames: int
    seconds: float
    damaged: int


def convert(
    path: Path,
    output: Path,
    options: SourceOptions,
    *,
    begin_s: float = 0.0,
    end_s: float = math.inf,
    color: ColorFormat = "png",
    force: bool = False,
) -> Converted:
    """Write the frames of a recording to a new MCAP file.

    Depth is as the recording has it, in millimeters; labels, poses and gravity come with it. `begin_s` and
    `end_s` are counted from the first frame, the latter excluded. Raises DriverError if the recording cannot
    be read, has no frame in that time, or the new file exists or cannot be written, and WriteError if the
    disk is full; then the new file is removed.
    """
    if output.suffix.lower() != ".mcap":
        raise DriverError(f"{output}: expected a name that ends in .mcap")
    with open_source(path, options) as source, written(output):
        if output.exists() and output.resolve() == path.resolve():
            raise DriverError(f"{output}: is the recording itself; name another file")
        check_absent(output, force=force)
        with ExitStack() as stack:
            writer: RecordingWriter | None = None
            span = _Span(source, begin_s, end_s)
            for frame in span:
                if writer is None:
                    if force:
                        # Not before: without a frame the old file stays.
                        remove_output(output)
                    stack.enter_context(_removed_if_full(output))
                    writer = RecordingWriter(
                        output, frame.calibration, color_format=color, metadata=source.metadata
                    )
                    stack.enter_context(writer)
                try:
                    writer.write(frame)
                except ValueError as err:
                    raise DriverError(f"{path}: frame {frame.index}: {err}") from err
        return span.converted(path, output)


def extract(
    path: Path,
    folder: Path,
    options: SourceOptions,
    *,
    begin_s: float = 0.0,
    end_s: float = math.inf,
    force: bool = False,
) -> Converted:
    """Write the frames of a recording to a folder of images, which can be replayed, as far as they know it.

    There are ``frame-NNNNNN.color.png``, ``.depth.png`` in millimeters, ``.label.png`` and ``.pose.txt``, and
    camera.toml. Their times are not kept. Raises as `convert` does; with `force` the folder may have files.
    """
    if not force and folder.is_dir() and any(folder.iterdir()):
        raise DriverError(f"{folder}: is not empty; name another folder, or add to it with --force")
    with open_source(path, options) as source, written(folder):
        folder.mkdir(parents=True, exist_ok=True)
        span = _Span(source, begin_s, end_s)
        calibration = None
        for frame in span:
            if calibration is None:
                calibration = frame.calibration
                write_calibration(folder / "camera.toml", calibration, depth_scale=1000)
            elif frame.calibration is not calibration:
                _log.warning("%s: frame %d: has other cameras than camera.toml says", path, frame.index)
                calibration = frame.calibration
            for name, content in _image_files(frame):
                write_atomically(folder / name, content)
        return span.converted(path, folder)


class _Span:
    """The frames of a source between two times after the first one; damaged ones are counted."""

    def __init__(self, source: FrameSource, begin_s: float, end_s: float) -> None:
        self._source, self._begin_s, self._end_s = source, begin_s, end_s
        self._times_ns: list[int] = []
        self._damaged = 0
        self._last_s: float | None = None

    def __iter__(self) -> Iterator[RGBDFrame]:
        since_ns = 0
        last_ns: int | None = None
        for frame in self._source.frames(self._leave_out):
            # Where a clock was set back, time goes on from there.
            since_ns += 0 if last_ns is None else max(0, frame.timestamp_ns - last_ns)
            last_ns = frame.timestamp_ns
            self._last_s = since_s = since_ns * 1e-9
            if since_s >= self._end_s:
                return
            if since_s >= self._begin_s:
                self._times_ns.append(since_ns)
                yield frame

    def _leave_out(self, err: FrameFormatError) -> None:
        self._damaged += 1
        _log.warning("left out a damaged frame: %s", err)

    def converted(self, path: Path, output: Path) -> Converted:
        """Return what was written; raises DriverError if it is nothing."""
        if not self._times_ns:
            end = "its end" if self._end_s == math.inf else f"{self._end_s:g} s"
            last = "there is none" if self._last_s is None else f"the last is at {self._last_s:.3g} s"
            raise DriverError(f"{path}: no frame from {self._begin_s:g} s to {end}; {last}")
        seconds = (self._times_ns[-1] - self._times_ns[0]) * 1e-9
        return Converted(str(output), len(self._times_ns), round(seconds, 3), self._damaged)


def _image_files(frame: RGBDFrame) -> Iterator[tuple[str, bytes]]:
    stem = f"frame-{frame.index:06d}"
    yield f"{stem}.color.png", _png(np.ascontiguousarray(frame.color[..., ::-1]))
    yield f"{stem}.depth.png", _png(frame.depth_mm)
    if frame.labels is not None:
        yield f"{stem}.label.png", _png(frame.labels)
    if frame.world_from_camera is not None:
        rows = (" ".join(map(repr, row)) for row in frame.world_from_camera.tolist())
        yield f"{stem}.pose.txt", ("\n".join(rows) + "\n").encode()


def _png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


@contextmanager
def _removed_if_full(output: Path) -> Iterator[None]:
    """Remove a file that the disk has no room for."""
    try:
        yield
    except OSError as err:
        if err.errno in FULL:
            remove_output(output)
        raise
