"""The command nurbseg-eval check: its arguments, what it prints, its exit code."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nurbseg.drivers.options import SourceOptions


def add_arguments(check: argparse.ArgumentParser) -> None:
    """Add the arguments that the other commands do not have."""
    check.add_argument(
        "folder", type=Path, metavar="DIR", help="of nurbseg-live --export DIR --export-surfaces"
    )
    check.add_argument(
        "--frames",
        dest="recording",
        metavar="RECORDING",
        help="what was segmented: recomputes the values from it",
    )
    check.add_argument("--calibration", type=Path, metavar="FILE", help="of both cameras, as of nurbseg-live")


def check_command(given: argparse.Namespace, options: SourceOptions) -> int:
    """Print what is wrong with a folder of exports, one finding a line, and then what was checked.

    Returns
    -------
    int
        0 where nothing was found, else 1.

    Raises
    ------
    ValueError
        If the folder holds no export.
    nurbseg.drivers.errors.DriverError
        If the recording cannot be read.
    """
    from nurbseg.app.evaluation.check.check import FolderCheck
    from nurbseg.drivers.calibration.file import read_camera_file

    if given.calibration is not None:
        options = replace(options, calibration=read_camera_file(given.calibration))
    started_s = time.perf_counter()
    check = FolderCheck(given.folder, given.recording, options)
    findings = 0
    for finding in check.findings():
        findings += 1
        print(finding)
    per_frame_ms = 1e3 * (time.perf_counter() - started_s) / max(check.frames, 1)
    print(
        f"{findings} findings in {check.frames} frames with {check.segments} segments; {check.recomputed} "
        f"surfaces held against their points; not checked: {check.history.unchecked} values and trials of "
        f"frames that are not there; {per_frame_ms:.0f} ms per frame",
        file=sys.stderr,
    )
    return 1 if findings else 0
