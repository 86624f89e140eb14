"""Frames with ground truth, from the command line of the benchmarks that compute scores."""

from __future__ import annotations

import argparse
import sys

from nurbseg.common.errors import DriverError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source


def frames_parser(doc: str | None, frames: str, nargs: str = "+") -> argparse.ArgumentParser:
    """Return a parser for frames, their intrinsics and the number of seeds; `doc` is a module's."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("frames", nargs=nargs, help=frames)
    add_intrinsics(parser)
    parser.add_argument("--seeds", type=int, default=5, help="seeds of the segmentation (%(default)s)")
    return parser


def numbers(text: str) -> tuple[float, ...]:
    """Return numbers that are separated by commas."""
    return tuple(map(float, text.split(",")))


def add_intrinsics(parser: argparse.ArgumentParser) -> None:
    """Add the flag for frames without calibration."""
    parser.add_argument(
        "--intrinsics",
        type=numbers,
        metavar="FX,FY,CX,CY",
        help="in pixels, for frames without calibration",
    )


def frames_of(path: str, given: argparse.Namespace) -> list[RGBDFrame]:
    """Read all frames of a recording; exits with 2 if it cannot be read."""
    try:
        with open_source(path, SourceOptions(intrinsics=given.intrinsics)) as source:
            return list(source)
    except (DriverError, ValueError) as err:
        print(err, file=sys.stderr)
        raise SystemExit(2) from None


def labelled_frames(path: str, given: argparse.Namespace) -> list[RGBDFrame]:
    """Read the frames of a recording that have ground truth; exits with 2 if there are none."""
    frames = [frame for frame in frames_of(path, given) if frame.labels is not None]
    if not frames:
        print(f"{path}: no frame has labels", file=sys.stderr)
        raise SystemExit(2)
    return frames
