"""What the argument parsers of the commands share."""

from __future__ import annotations

import argparse
from pathlib import Path


def command_parser(
    prog: str, description: str, epilog: str, usage: str | None = None
) -> argparse.ArgumentParser:
    """Return a parser that keeps the lines of its texts, and takes flags at full length only."""
    return argparse.ArgumentParser(
        prog=prog,
        usage=usage,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


def add_setting_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that choose a segmentation's settings."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="read settings from a TOML file")
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a segmentation setting; may be repeated",
    )


def add_calibration_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say what recordings without calibration do not."""
    parser.add_argument("--intrinsics", metavar="FX,FY,CX,CY", help="of data without calibration, pixels")
    parser.add_argument("--depth-scale", type=float, help="depth units per metre of data that does not say")
