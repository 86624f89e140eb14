"""Checks and rewrites files of Rerun's viewer (.rrd) with Rerun's own program."""

import subprocess
import warnings
from pathlib import Path

from nurbseg.app.view.viewer import viewer_executable
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.files import create_private

#: Longest wait for Rerun to read or write a file, seconds.
_LIMIT_S = 3600.0
#: An entity with one image per frame.
_SHOWN = "world/camera/image/depth"


class WriteError(DriverError):
    """A new file cannot be written to its end."""


def complaint(*words: str) -> str:
    """Run Rerun's program; return its error message, or an empty text."""
    try:
        done = subprocess.run(
            [viewer_executable(), *words], capture_output=True, text=True, timeout=_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_LIMIT_S:g} s"
    if done.returncode == 0:
        return ""
    said = [line for line in done.stderr.splitlines() if line.strip()]
    return said[-1] if said else f"exit code {done.returncode}"


def rewrite(path: Path, output: Path) -> None:
    """Write the readable part of a file, with an index, to a new one.

    Raises OSError if the new file cannot be created, WriteError if it cannot be completed, and DriverError
    if Rerun fails otherwise.
    """
    create_private(output).close()
    problem = complaint("rrd", "optimize", "--continue-on-error", str(path), "-o", str(output))
    if "(os error " in problem:
        raise WriteError(f"{path}: its copy cannot be written: {problem}")
    if problem:
        raise DriverError(f"{path}: Rerun cannot rewrite it: {problem}")


def stamps_ns(path: Path) -> list[int]:
    """Return the timestamps of a file's frames; raises RuntimeError if the file is truncated."""
    # Late: Rerun is slow to import.
    from rerun.chunk import RrdReader

    found: dict[int, int] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for chunk in RrdReader(str(path)).stream():
            if chunk.entity_path.strip("/") == _SHOWN and not chunk.is_static:
                batch = chunk.to_record_batch()
                times = batch.column("device_time").cast("int64")
                found.update(zip(batch.column("frame").to_pylist(), times.to_pylist(), strict=True))
    return [found[frame] for frame in sorted(found)]
