"""Rerun's files (.rrd), as Rerun's own program and library read them, in processes of their own.

Run as a program, this prints the timestamps of a file's frames: on a damaged file, the library may fail in
any way.
"""

import json
import shlex
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from nurbseg.app.view.viewer import viewer_executable
from nurbseg.common.errors import RecordingFormatError, in_utf8
from nurbseg.common.process.child import (
    environment,
    exit_description,
    python_command,
    with_parent_death_signal,
)

#: Longest wait for Rerun to read a file, seconds.
_LIMIT_S = 3600.0
#: An entity with one image per frame.
_SHOWN = "world/camera/image/depth"
#: What Rerun says of a file that ends too early.
_CUT = ("exceeds file size", "too small to be an RRD", "No recording store found")
#: Characters of its messages that are passed on.
_QUOTED = 300


@contextmanager
def named_for_rerun(path: Path) -> Iterator[Path]:
    """Yield an absolute path of a file that Rerun can take: a link to it where its own is not UTF-8."""
    path = path.absolute()
    if in_utf8(str(path)) == str(path):
        yield path
        return
    with TemporaryDirectory() as folder:
        link = Path(folder) / f"recording{path.suffix}"
        link.symlink_to(path)
        yield link


def complaint(*words: str) -> str:
    """Run Rerun's program; return its error message, or an empty text."""
    return _run([str(viewer_executable()), *words])[1]


def stamps_ns(path: Path) -> list[int]:
    """Return the timestamps of a file's frames; raises RecordingFormatError if it is cut off or damaged."""
    command = python_command("nurbseg.app.recording.rrd", str(path.absolute()))
    printed, problem = _run(with_parent_death_signal(command))
    if problem:
        was_cut = any(text in problem for text in _CUT)
        reason = "it is cut off: its writer was killed, or the disk was full" if was_cut else "it is damaged"
        raise RecordingFormatError(f"{reason} ({problem})")
    return [int(each) for each in json.loads(printed)]


def readable_stamps_ns(path: Path) -> list[int]:
    """Return the timestamps of those frames that a damaged file still gives; none if Rerun gives up on it."""
    with TemporaryDirectory() as folder:
        readable = Path(folder) / "readable.rrd"
        words = ("rrd", "optimize", "--continue-on-error", str(path.absolute()), "-o", str(readable))
        if complaint(*words) or not readable.is_file():
            return []
        try:
            return stamps_ns(readable)
        except RecordingFormatError:
            return []


def repair_command(path: Path) -> str:
    """Return the command of Rerun's that writes the readable part of a file to a new one."""
    old, new = (shlex.quote(str(each.absolute())) for each in (path, path.with_stem(f"{path.stem}-repaired")))
    return f"rerun rrd optimize --continue-on-error {old} -o {new}"


def _run(command: Sequence[str]) -> tuple[str, str]:
    """Run a program; return what it prints, and what is wrong."""
    try:
        done = subprocess.run(
            command,
            env=environment(),
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "", f"no answer within {_LIMIT_S:g} s"
    if done.returncode == 0:
        return done.stdout, ""
    said = [line for line in done.stderr.splitlines() if line.strip()]
    return "", said[-1][:_QUOTED] if said else f"Rerun {exit_description(done.returncode)}"


def _read(path: str) -> list[int]:
    # Late: Rerun is slow to import.
    from rerun.chunk import RrdReader

    found: dict[int, int] = {}
    for chunk in RrdReader(path).stream():
        if chunk.entity_path.strip("/") == _SHOWN and not chunk.is_static:
            batch = chunk.to_record_batch()
            if not {"frame", "device_time"} <= set(batch.schema.names):
                continue  # of another program
            times = batch.column("device_time").cast("int64")
            found.update(zip(batch.column("frame").to_pylist(), times.to_pylist(), strict=True))
    return [found[frame] for frame in sorted(found)]


def main() -> None:
    """Print the timestamps of a file's frames as JSON, nanoseconds."""
    warnings.simplefilter("ignore")
    print(json.dumps(_read(sys.argv[1])))


if __name__ == "__main__":
    main()
