"""Writes frames of any recording to a new one or to a folder of images, and repairs recordings."""

import errno
import logging
import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import DriverError, FrameFormatError
from nurbseg.common.files import check_absent, remove_output, replacing, write_atomically
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.calibration.file import write_calibration
from nurbseg.drivers.mcap.writer import RecordingWriter, rewrite
from nurbseg.drivers.options import ColorFormat, SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: Of a disk or a quota that is full, and of a file that must not grow.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class WriteError(DriverError):
    """A new file cannot be written to its end."""


@dataclass(slots=True)
class Converted:
    """What was written, as ``nurbseg-record --json`` prints it; `damaged` frames were left out."""

    file: str
    frames: int = 0
    seconds: float = 0.0
    damaged: int = 0

    @property
    def whole(self) -> bool:
        """Whether no frame was left out."""
        return not self.damaged

    def as_text(self) -> str:
        """Return it for a person."""
        damaged = f", {self.damaged} damaged ones left out" if self.damaged else ""
        return f"{self.file}: {self.frames} frames, {self.seconds:.3f} s{damaged}"


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
    done = Converted(str(output))
    with open_source(path, options) as source, _written(output, remove=True), ExitStack() as stack:
        if output.exists() and output.resolve() == path.resolve():
            raise DriverError(f"{output}: is the recording itself; name another file")
        check_absent(output, force=force)
        writer: RecordingWriter | None = None
        for frame in _part(path, source, begin_s, end_s, done):
            if writer is None:
                if force:
                    # Not before: without a frame the old file stays.
                    remove_output(output)
                writer = stack.enter_context(
                    RecordingWriter(output, frame.calibration, color_format=color, metadata=source.metadata)
                )
            try:
                writer.write(frame)
            except ValueError as err:
                raise DriverError(f"{path}: frame {frame.index}: {err}") from err
    return done


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
    done = Converted(str(folder))
    with open_source(path, options) as source, _written(folder):
        folder.mkdir(parents=True, exist_ok=True)
        calibration = None
        for frame in _part(path, source, begin_s, end_s, done):
            if calibration is None:
                calibration = frame.calibration
                write_calibration(folder / "camera.toml", calibration, depth_scale=1000)
            elif frame.calibration is not calibration:
                _log.warning("%s: frame %d: has other cameras than camera.toml says", path, frame.index)
                calibration = frame.calibration
            for name, content in _image_files(frame):
                write_atomically(folder / name, content)
    return done


def repair(path: Path, output: Path, *, force: bool = False) -> list[str]:
    """Write the readable part of an MCAP recording to a new file; return remarks on what was left out.

    The new file appears when it is complete, and only this user may read it. `force` replaces an existing
    file, even `path` itself. Raises DriverError if nothing can be read, or the new file exists or cannot be
    created, and WriteError if the disk is full.
    """
    with _written(output):
        check_absent(output, force=force)
        with replacing(output, mode=0o600) as file:
            damaged = rewrite(path, file)
    return [f"damaged parts of {path} that were left out: {damaged}"] if damaged else []


@contextmanager
def _written(output: Path, *, remove: bool = False) -> Iterator[None]:
    """Report which file cannot be written; remove one for which the disk has no room."""
    try:
        yield
    except OSError as err:
        if isinstance(err, DriverError):
            raise
        advice = ", or overwrite it with --force" if isinstance(err, FileExistsError) else ""
        kind = WriteError if err.errno in _FULL else DriverError
        if remove and kind is WriteError:
            remove_output(output)
        raise kind(f"{output}: cannot be written: {err.strerror}{advice}") from err


def _part(
    path: Path, source: FrameSource, begin_s: float, end_s: float, done: Converted
) -> Iterator[RGBDFrame]:
    """Yield the frames between two times after the first one, and count them; DriverError if none are."""

    def leave_out(err: FrameFormatError) -> None:
        done.damaged += 1
        _log.warning("left out a damaged frame: %s", err)

    since_ns = begun_ns = 0
    last_ns: int | None = None
    for frame in source.frames(leave_out):
        # Where a clock was set back, time goes on from there.
        since_ns += 0 if last_ns is None else max(0, frame.timestamp_ns - last_ns)
        last_ns = frame.timestamp_ns
        if since_ns * 1e-9 >= end_s:
            break
        if since_ns * 1e-9 >= begin_s:
            begun_ns = begun_ns if done.frames else since_ns
            done.frames += 1
            done.seconds = round((since_ns - begun_ns) * 1e-9, 3)
            yield frame
    if not done.frames:
        end = "its end" if end_s == math.inf else f"{end_s:g} s"
        last = "there is none" if last_ns is None else f"the last is at {since_ns * 1e-9:.3g} s"
        raise DriverError(f"{path}: no frame from {begin_s:g} s to {end}; {last}")


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
