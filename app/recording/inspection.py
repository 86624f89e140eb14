"""Inspects and repairs recordings: which frames they contain, and what is missing."""

import errno
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from nurbseg.app.recording.info import LONGEST_STEP_S, stamp_findings
from nurbseg.common.errors import (
    BackendMissingError,
    DriverError,
    RecordingFormatError,
)
from nurbseg.common.files import MCAP_MAGIC, ONI_MAGIC, check_absent, open_regular, replacing
from nurbseg.drivers.calibration.foreign import HEAD_BYTES, what_it_is
from nurbseg.drivers.mcap import writer as mcap
from nurbseg.drivers.mcap.container.parts import parts_in
from nurbseg.drivers.openni2.oni.file import read_structure
from nurbseg.drivers.registry import open_source

Form = Literal["mcap", "oni"]

_FORMS: dict[bytes, Form] = {MCAP_MAGIC: "mcap", ONI_MAGIC: "oni"}
#: Minimum length of a gap between frames, as a multiple of the usual period.
_GAP_STEPS = 1.5
#: Of a disk or a quota that is full, and of a file that must not grow.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class WriteError(DriverError):
    """A new file cannot be written to its end."""


@contextmanager
def written(output: Path) -> Iterator[None]:
    """Say which file cannot be written."""
    try:
        yield
    except OSError as err:
        if isinstance(err, DriverError):
            raise
        advice = ", or overwrite it with --force" if isinstance(err, FileExistsError) else ""
        kind = WriteError if err.errno in FULL else DriverError
        raise kind(f"{output}: cannot be written: {err.strerror}{advice}") from err


@dataclass(slots=True)
class Inspection:
    """The state of a recording, as ``nurbseg-record --json`` prints it."""

    file: str
    form: Form
    #: Number of readable frames, and their first and last timestamps.
    frames: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    #: Frames per second, without jumps of the clock; 0 if unknown.
    rate_hz: float = 0.0
    #: The frame before each gap, counted from 0, and the gap's length, seconds.
    gaps: list[tuple[int, float]] = field(default_factory=list)
    #: Whether it was closed properly.
    end_written: bool = True
    #: What is wrong with the stamps.
    stamps: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    @property
    def whole(self) -> bool:
        """Whether there are no problems."""
        return not self.problems


def form_of(path: Path) -> Form:
    """Return a file's format by its first bytes.

    Raises RecordingFormatError if it cannot be read, or has another format.
    """
    if path.is_dir():
        raise RecordingFormatError(
            f"{path}: expected an .mcap or .oni file, got a folder; nurbseg-record info tells of it"
        )
    with open_regular(path) as file:
        head = file.read(HEAD_BYTES)
    form = next((form for start, form in _FORMS.items() if head.startswith(start)), None)
    if form is None:
        if (kind := what_it_is(head, path)) is not None:
            raise RecordingFormatError(f"{path}: is neither .mcap nor .oni, but {kind}")
        raise RecordingFormatError(f"{path}: magic bytes: expected an .mcap or .oni file")
    return form


def inspect(path: Path) -> Inspection:
    """Read a recording, or the folder of a bag that was split, completely and check it.

    Raises DriverError if nothing can be read.
    """
    form: Form = "mcap" if path.is_dir() and parts_in(path) else form_of(path)
    found = Inspection(str(path), form)
    (_inspect_oni if form == "oni" else _inspect_mcap)(path, found)
    if not found.frames:
        found.problems.append("it contains no frames")
    return found


def _inspect_mcap(path: Path, found: Inspection) -> None:
    found.end_written = _read_frames(path, found)["whole"] == "true"
    if not found.end_written:
        found.problems.append("it was not closed properly: the recorder was killed, or the disk was full")


def _inspect_oni(path: Path, found: Inspection) -> None:
    file = read_structure(path)
    found.end_written = file.complete
    if not file.complete:
        found.problems.append("it was not closed properly: the recorder was killed; it plays up to there")
    try:
        _read_frames(path, found)
    except BackendMissingError:
        found.remarks.append("OpenNI2 is not installed: the images were not decoded")
    if not found.frames:
        # The stored images that would be played.
        played = file.depth.frames[: len(file.color.frames)]
        _count(found, [1000 * frame.timestamp_us for frame in played])


def _read_frames(path: Path, found: Inspection) -> dict[str, str]:
    """Decode every frame; return the source's metadata."""
    damaged: list[str] = []
    with open_source(path) as source:
        stamps = [frame.timestamp_ns for frame in source.frames(lambda err: damaged.append(str(err)))]
    if damaged:
        found.problems.append(f"{len(damaged)} damaged: {damaged[0]}")
    if dropped := int(source.metadata.get("dropped", 0)):
        lost = f"images without a partner, which are in no frame: {dropped}"
        (found.problems if dropped > len(stamps) else found.remarks).append(lost)
    if lost_labels := source.metadata.get("labels_lost"):
        found.remarks.append(f"labels that cannot be used: {lost_labels}")
    _count(found, stamps)
    found.stamps = stamp_findings(stamps, source.metadata)
    return source.metadata


def _count(found: Inspection, stamps: Sequence[int]) -> None:
    found.frames = len(stamps)
    if stamps:
        found.first_ns, found.last_ns = stamps[0], stamps[-1]
    if len(stamps) > 2:
        steps = np.diff(np.array(stamps, dtype=np.int64)).astype(np.float64) * 1e-9
        forward = steps[(steps > 0) & (steps < LONGEST_STEP_S)]
        found.rate_hz = round(float(1 / forward.mean()), 1) if forward.size else 0.0
        after = np.flatnonzero(steps > _GAP_STEPS * np.median(steps))
        found.gaps = [(int(frame), round(float(steps[frame]), 3)) for frame in after]


def repair(path: Path, output: Path, *, force: bool = False) -> list[str]:
    """Write the readable part of an MCAP recording to a new file; return remarks on what was left out.

    The new file appears when it is complete, and only this user may read it. `force` replaces an existing
    file, even `path` itself. Raises DriverError if nothing can be read, or the new file exists or cannot be
    created, and WriteError if the disk is full.
    """
    if form_of(path) == "oni":
        raise RecordingFormatError(f"{path}: only .mcap is repaired; nurbseg-record convert reads an .oni")
    with written(output):
        check_absent(output, force=force)
        with replacing(output, mode=0o600) as file:
            damaged = mcap.rewrite(path, file)
    return [f"damaged parts of {path} that were left out: {damaged}"] if damaged else []
