"""The command nurbseg-record, which checks, repairs, cuts and converts recordings."""

from __future__ import annotations

import argparse
import json
import logging
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nurbseg.app.errors import message_handler
from nurbseg.app.parser import command_parser
from nurbseg.common.errors import printable

if TYPE_CHECKING:
    from nurbseg.app.recording.conversion import Converted
    from nurbseg.app.recording.inspection import Inspection

WHOLE, NOT_WHOLE, UNREADABLE = 0, 1, 2

_DESCRIPTION = """\
Info lists what a recording of any kind holds and how it would be replayed. Check reads it to its end: how
many frames it contains, where some are missing, whether it was closed properly, and what is wrong with its
stamps. Repair writes everything that can be read of an .mcap to a new, complete file, which opens in Rerun,
Foxglove and ROS. Cut, convert and extract write frames of anything that can be replayed: .db3, .bag, .oni,
folders, data sets."""

_EPILOG = """\
exit codes: 0 all intact; 1 a problem was found, or the disk is full; 2 usage, or a file cannot be read;
130 interrupted (Ctrl-C, SIGTERM or SIGHUP)
example: nurbseg-record info bag; nurbseg-record check *.mcap
example: nurbseg-record cut a.db3 b.mcap --from 2 --to 5"""

_SOURCE = ("depth-topic", "color-topic", "calibration", "depth-scale")
_PART = ("from", "to", "force")
#: What each command does, what it writes to, and its flags besides --json.
_COMMANDS = {
    "info": ("list streams, units, calibration and clocks of recordings", "", _SOURCE),
    "check": ("read recordings to the end and report problems", "", _SOURCE),
    "repair": ("write a complete copy of each damaged recording", "", ("out", "force")),
    "cut": ("write part of a recording to a new one", "OUT.mcap", (*_PART, "color", *_SOURCE)),
    "convert": ("write a recording as .mcap", "OUT.mcap", (*_PART, "color", *_SOURCE)),
    "extract": ("write the frames as images, with camera.toml", "FOLDER", (*_PART, *_SOURCE)),
}


def main(words: Sequence[str] | None = None) -> int:
    """Run the command with the process's arguments, or others; return its exit code."""
    logging.basicConfig(handlers=[message_handler("nurbseg-record")])
    parser = _parser()
    given = parser.parse_args(words)
    if given.command == "repair" and given.out is not None and len(given.paths) > 1:
        parser.error("--out: takes one recording at a time")
    from nurbseg.app.recording.conversion import WriteError
    from nurbseg.common.errors import DriverError

    worst = WHOLE
    found = []
    for path in given.paths:
        try:
            result = _result(given, path)
        except (DriverError, ValueError) as err:
            print(f"nurbseg-record: error: {printable(str(err))}", file=sys.stderr)
            worst = max(worst, NOT_WHOLE if isinstance(err, WriteError) else UNREADABLE)
            continue
        found.append(asdict(result))
        if not given.json:
            print(result.as_text())
        worst = max(worst, NOT_WHOLE if result.whole is False else WHOLE)
    if given.json and (found or "output" not in given):
        print(json.dumps(found[0] if "output" in given else found, indent=2))
    return worst


def _parser() -> argparse.ArgumentParser:
    moment = {"type": _seconds, "metavar": "S"}
    flags: dict[str, dict[str, Any]] = {
        "from": {**moment, "default": 0.0, "help": "first moment written, seconds after the first frame"},
        "to": {**moment, "default": math.inf, "help": "end of the part, seconds after the first frame"},
        "color": {"choices": ("png", "jpeg95", "raw"), "default": "png", "help": "form of color (png)"},
        "depth-topic": {"metavar": "TOPIC", "help": "topic of the depth images"},
        "color-topic": {"metavar": "TOPIC", "help": "topic of the color images"},
        "calibration": {"type": Path, "metavar": "FILE", "help": "counts before the recording's own"},
        "depth-scale": {"type": float, "metavar": "1/M", "help": "depth units per meter"},
        "out": {"type": Path, "metavar": "FILE", "help": "the new file (NAME-repaired beside it)"},
        "force": {"action": "store_true", "help": "overwrite what exists"},
        "json": {"action": "store_true", "help": "write the results as JSON"},
    }
    parser = command_parser("nurbseg-record", _DESCRIPTION, _EPILOG)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (what, output, names) in _COMMANDS.items():
        command = commands.add_parser(name, help=what)
        count: Any = 1 if output else "+"
        command.add_argument("paths", nargs=count, type=Path, metavar="PATH", help="a recording")
        if output:
            command.add_argument("output", type=Path, metavar=output, help="what is written")
        for flag in (*names, "json"):
            required = name == "cut" and flag in ("from", "to")
            command.add_argument(f"--{flag}", required=required, **flags[flag])
    return parser


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not seconds >= 0:
        raise argparse.ArgumentTypeError(f"expected seconds of 0 or more, got {text!r}")
    return seconds


def _result(given: argparse.Namespace, path: Path) -> Inspection | Converted:
    """Do what a command does with one recording."""
    from nurbseg.app.recording import conversion, inspection
    from nurbseg.common.files import is_stream
    from nurbseg.drivers.options import SourceOptions

    if given.command == "repair":
        output = given.out or path.with_stem(f"{path.stem}-repaired")
        left_out = conversion.repair(path, output, force=given.force)
        # What a pipe got only its reader can check; the recording itself is, then.
        repaired = inspection.inspect(path if is_stream(output) else output)
        repaired.remarks += left_out
        return repaired
    options = SourceOptions(
        depth_topic=given.depth_topic,
        color_topic=given.color_topic,
        calibration=given.calibration,
        depth_scale=given.depth_scale,
    )
    if given.command in ("info", "check"):
        return (inspection.inform if given.command == "info" else inspection.inspect)(path, options)
    span = {"begin_s": vars(given)["from"], "end_s": given.to, "force": given.force}
    if given.command == "extract":
        return conversion.extract(path, given.output, options, **span)
    return conversion.convert(path, given.output, options, color=given.color, **span)
