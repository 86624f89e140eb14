"""Reads a file in a process of its own that may not take much: a reader gone wrong fails its test only."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

#: Address space that a child may take, bytes: its libraries take about one.
_ADDRESS_SPACE = 6 << 30
_CPU_S = 60
_TIMEOUT_S = 120.0
_PROGRAM = r"""
import json, re, sys
from pathlib import Path
from nurbseg.drivers import DriverError, EndOfRecordingError, FrameFormatError, open_source
from nurbseg.drivers.calibration.file import read_camera_file

path, frames_most = Path(sys.argv[1]), int(sys.argv[2])
# What the libraries take is loaded before it is measured.
import cv2, lz4.frame, scipy.spatial.transform, yaml, zstandard
import nurbseg.drivers.datasets.folders
from nurbseg.drivers import RecordingReader


def peak_kib():
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])


before = peak_kib()
frames, errors = 0, []
try:
    if path.suffix in (".yml", ".yaml", ".xml", ".toml", ".json", ".txt"):
        read_camera_file(path)
    else:
        with open_source(path) as source:
            while frames + len(errors) < frames_most:
                try:
                    source.read()
                    frames += 1
                except FrameFormatError as err:
                    errors.append(f"{type(err).__name__}: {err}")
except EndOfRecordingError:
    pass
except DriverError as err:
    errors.append(f"{type(err).__name__}: {err}")
print(json.dumps({"frames": frames, "errors": errors, "taken_bytes": (peak_kib() - before) * 1024}))
"""


@dataclass(frozen=True)
class Reading:
    """What came of reading a file.

    Parameters
    ----------
    frames : int
        Frames that were read.
    errors : list of str
        Type and message of each typed error.
    taken_bytes : int
        Memory taken at most, beyond what the libraries take.
    """

    frames: int
    errors: list[str]
    taken_bytes: int


def read_bounded(path: Path, *, frames_most: int = 100) -> Reading:
    """Read a recording or calibration file to its end.

    Raises
    ------
    AssertionError
        If the process crashed, took too much memory or processor time, or met an error that is not typed.
    """

    def bound() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (_CPU_S, _CPU_S))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    child = subprocess.run(
        [sys.executable, "-P", "-c", _PROGRAM, str(path), str(frames_most)],
        capture_output=True,
        text=True,
        timeout=_TIMEOUT_S,
        preexec_fn=bound,
    )
    assert child.returncode == 0, f"{path.name}: ended with {child.returncode}: {child.stderr[-2000:]}"
    return Reading(**json.loads(child.stdout.splitlines()[-1]))


__all__ = ["Reading", "read_bounded"]
