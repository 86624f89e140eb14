"""The command nurbseg-record, which checks, repairs, cuts and converts recordings."""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from nurbseg.app.errors import message_handler
from nurbseg.app.parser import command_parser
from nurbseg.common.errors import printable

if TYPE_CHECKING:
    from nurbseg.app.recording.inspection import Inspection

WHOLE, NOT_WHOLE, UNREADABLE = 0, 1, 2

_WRITING = {
    "cut": "write part of a recording of any kind to a new one",
    "convert": "write a recording of any kind as .mcap",
    "extract": "write the frames of a recording of any kind as images, with camera.toml",
}

_DESCRIPTION = """\
Check recordings (.mcap, .oni): how many frames they contain, where some are missing, whether they were
closed properly, and what is wrong with their stamps. Info lists what a recording holds and how it would be
replayed. Repair writes everything that can be read of an .mcap to a new, complete file, which opens in Rerun,
Foxglove and ROS. Cut, convert and extract write frames of anything that can be replayed: .db3, .bag, .oni,
folders, data sets."""

_EPILOG = """\
exit codes: 0 all intact; 1 a problem was found, or the disk is full; 2 usage, or a file cannot be read;
130 interrupted (Ctrl-C, SIGTERM or SIGHUP)
example: nurbseg-record info bag; nurbseg-record check *.mcap
example: nurbseg-record cut a.db3 b.mcap --from 2 --to 5"""


def main(words: Sequence[str] | None = None) -> int:
    """Run the command with the process's arguments, or others; return its exit code."""
    logging.basicConfig(handlers=[message_handler("nurbseg-record")])
    given = _parser().parse_args(words)
    if given.command in _WRITING:
        return _converted(given)
    from nurbseg.app.recording.inspection import WriteError
    from nurbseg.common.errors import DriverError

    if given.command == "repair" and given.out is not None and len(given.files) > 1:
        _parser().error("--out: takes one recording at a time")
    worst = WHOLE
    found = []
    for file in given.files:
        try:
            if given.command == "info":
                found.append(_informed(given, file))
                continue
            inspection = _inspected(given, file)
        except DriverError as err:
            print(f"nurbseg-record: error: {printable(str(err))}", file=sys.stderr)
            worst = max(worst, NOT_WHOLE if isinstance(err, WriteError) else UNREADABLE)
            continue
        found.append({**asdict(inspection), "whole": inspection.whole})
        worst = max(worst, WHOLE if inspection.whole else NOT_WHOLE)
    if given.json:
        print(json.dumps(found, indent=2))
    return worst


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("nurbseg-record", _DESCRIPTION, _EPILOG)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    info = commands.add_parser("info", help="list streams, units, calibration and clocks of recordings")
    info.add_argument("files", nargs="+", type=Path, metavar="PATH", help="a recording of any kind")
    info.add_argument("--json", action="store_true", help="write the results as JSON")
    for kind in ("depth", "color"):
        info.add_argument(f"--{kind}-topic", metavar="TOPIC", help=f"as if this were the {kind} images")
    check = commands.add_parser("check", help="read recordings to the end and report problems")
    repair = commands.add_parser("repair", help="write a complete copy of each damaged recording")
    for command in (check, repair):
        command.add_argument("files", nargs="+", type=Path, metavar="FILE", help=".mcap or .oni")
        command.add_argument("--json", action="store_true", help="write the results as JSON")
    for name, what in _WRITING.items():
        _add_writing(commands.add_parser(name, help=what), name)
    repair.add_argument("--out", type=Path, metavar="FILE", help="the new file (NAME-repaired beside it)")
    repair.add_argument("--force", action="store_true", help="overwrite the new file if it exists")
    return parser


def _add_writing(command: argparse.ArgumentParser, name: str) -> None:
    command.add_argument("path", type=Path, metavar="PATH", help="a recording of any kind")
    output = "FOLDER" if name == "extract" else "OUT.mcap"
    command.add_argument("output", type=Path, metavar=output, help="what is written")
    for flag, default, text in (("from", 0.0, "first"), ("to", math.inf, "end")):
        command.add_argument(
            f"--{flag}",
            type=_seconds,
            default=default,
            required=name == "cut",
            metavar="S",
            help=f"{text} moment that is written, seconds after the first frame",
        )
    if name != "extract":
        colors = ("png", "jpeg95", "raw")
        command.add_argument("--color", choices=colors, default="png", help="how color is kept (png)")
    for kind in ("depth", "color"):
        command.add_argument(f"--{kind}-topic", metavar="TOPIC", help=f"topic of the {kind} images")
    command.add_argument("--calibration", type=Path, metavar="FILE", help="counts before the recording's own")
    command.add_argument("--depth-scale", type=float, metavar="1/M", help="depth units per meter")
    command.add_argument("--force", action="store_true", help="overwrite what exists")
    command.add_argument("--json", action="store_true", help="write the result as JSON")


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not seconds >= 0:
        raise argparse.ArgumentTypeError(f"expected seconds of 0 or more, got {text!r}")
    return seconds


def _converted(given: argparse.Namespace) -> int:
    """Write a recording, or part of it, in another form."""
    from nurbseg.app.recording import conversion
    from nurbseg.app.recording.inspection import WriteError
    from nurbseg.common.errors import DriverError
    from nurbseg.drivers.options import SourceOptions

    span = {"begin_s": vars(given)["from"], "end_s": given.to, "force": given.force}
    try:
        options = SourceOptions(
            depth_topic=given.depth_topic,
            color_topic=given.color_topic,
            calibration=given.calibration,
            depth_scale=given.depth_scale,
        )
        if given.command == "extract":
            done = conversion.extract(given.path, given.output, options, **span)
        else:
            done = conversion.convert(given.path, given.output, options, color=given.color, **span)
    except (DriverError, ValueError) as err:
        print(f"nurbseg-record: error: {printable(str(err))}", file=sys.stderr)
        return NOT_WHOLE if isinstance(err, WriteError) else UNREADABLE
    if given.json:
        print(json.dumps(asdict(done), indent=2))
    else:
        damaged = f", {done.damaged} damaged ones left out" if done.damaged else ""
        print(f"{done.file}: {done.frames} frames, {done.seconds:.3f} s{damaged}")
    return NOT_WHOLE if done.damaged else WHOLE


def _informed(given: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Say what a recording holds."""
    from nurbseg.app.recording.info import as_text, inform
    from nurbseg.drivers.options import SourceOptions

    options = SourceOptions(depth_topic=given.depth_topic, color_topic=given.color_topic)
    found = inform(path, options)
    if not given.json:
        print(as_text(found))
    return asdict(found)


def _inspected(given: argparse.Namespace, file: Path) -> Inspection:
    """Inspect a file, or its repaired copy."""
    from nurbseg.app.recording.inspection import inspect

    if given.command == "check":
        found = inspect(file)
    else:
        output = given.out or file.with_stem(f"{file.stem}-repaired")
        found = _repaired(file, output, force=given.force)
    if not given.json:
        print(_text(found))
        if given.command == "check" and not found.whole and found.form == "mcap" and file.is_file():
            print(f"  to repair it: nurbseg-record repair {shlex.quote(str(file))}")
    return found


def _repaired(file: Path, output: Path, *, force: bool) -> Inspection:
    """Write the readable part of a recording, and inspect what was written."""
    from nurbseg.app.recording.inspection import inspect, repair, written
    from nurbseg.common.files import is_stream, replacing

    if is_stream(output):
        # Only its reader can read it.
        with TemporaryDirectory() as folder, written(output), replacing(output) as stream:
            whole = Path(folder) / file.name
            found = _repaired(file, whole, force=force)
            with whole.open("rb") as content:
                shutil.copyfileobj(content, stream)
        return replace(found, file=str(output))
    left_out = repair(file, output, force=force)
    found = inspect(output)
    found.remarks += left_out
    return found


def _text(found: Inspection) -> str:
    span_s = 0.0
    if found.first_ns is not None and found.last_ns is not None:
        span_s = (found.last_ns - found.first_ns) * 1e-9
    rate = f", {found.rate_hz:.1f} frames/s" if found.rate_hz else ""
    frames = f"{found.frames} frame{'s' * (found.frames != 1)}{rate}"
    lines = [f"{found.file}: {'whole' if found.whole else 'NOT whole'}, {frames}"]
    if found.last_ns is not None:
        lines.append(f"  last frame: {span_s:.3f} s after the first, stamp {found.last_ns * 1e-9:.6f} s")
    if found.gaps:
        frame, longest_s = max(found.gaps, key=lambda gap: gap[1])
        lines.append(f"  gaps: {len(found.gaps)}, the longest {longest_s:.3f} s, after frame {frame}")
    lines += [f"  stamps: {finding}" for finding in found.stamps]
    lines += [f"  wrong: {problem}" for problem in found.problems]
    lines += [f"  note: {remark}" for remark in found.remarks]
    return printable(os.linesep.join(lines))
