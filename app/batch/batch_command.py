"""The command nurbseg-batch, which segments many recordings on all cores or a cluster."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nurbseg.app.command.arguments import add_flag
from nurbseg.app.errors import message_handler
from nurbseg.app.parser import add_calibration_flags, add_setting_flags, command_parser
from nurbseg.app.settings.app_config import warn_of_unread
from nurbseg.app.settings.output_config import ExportConfig, export_forms
from nurbseg.common.computer import limit_blas_threads
from nurbseg.common.settings import changed_paths

if TYPE_CHECKING:
    from nurbseg.app.batch.batch import Recording

#: The report on all recordings.
REPORT_FILE = "report.json"

_DESCRIPTION = """\
Segment every frame of many recordings independently, and write the files of nurbseg-live --export into one
folder per recording: --export DIR and recordings/a.mcap give DIR/recordings/a.mcap, and /data/a.mcap gives
DIR/data/a.mcap."""

_EPILOG = """\
exit codes: 0 all done, 1 some recordings failed (they are listed at the end), 2 usage, 130 interrupted
(Ctrl-C, SIGTERM or SIGHUP); the same command resumes, and repeats what failed
example: nurbseg-batch recordings/*.mcap --export out --workers auto"""


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("nurbseg-batch", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add(
        "recordings",
        nargs="+",
        metavar="PATH",
        help="recordings to replay, as for nurbseg-live: files and folders",
    )
    add("--export", type=Path, metavar="DIR", required=True, help="folder for the results and report.json")
    for each in export_forms():
        add_flag(parser, f"export.{each.name}", each)
    add("--workers", metavar="N|auto", default="auto", help="processes; auto: one per core (%(default)s)")
    add("--scheduler", metavar="URL", help="a Dask scheduler, tcp://HOST:8786, instead of --workers")
    add_setting_flags(parser)
    add_calibration_flags(parser)
    return parser


def main(words: Sequence[str] | None = None) -> int:
    """Run the command with the process's arguments, or others; return its exit code."""
    limit_blas_threads()
    logging.basicConfig(handlers=[message_handler("nurbseg-batch")])
    given = _parser().parse_args(words)
    given.seed = None
    try:
        return _run(given)
    except ModuleNotFoundError as err:
        return _refused(
            f"{err.name} is not installed; a cluster needs the extra 'eval': pip install '.[eval]'"
        )
    except (OSError, ValueError) as err:
        return _refused(str(err))
    except KeyboardInterrupt:
        print("nurbseg-batch: interrupted; run the same command to resume", file=sys.stderr)
        return 130


def _run(given: argparse.Namespace) -> int:
    from nurbseg.app.command.segmentation_arguments import base_config, source_options
    from nurbseg.app.workers import open_workers
    from nurbseg.common.computer import process_count

    config, options = base_config(given), source_options(given)
    warn_of_unread(changed_paths(config), [config.method])
    count = process_count("auto" if given.workers == "auto" else _number(given.workers))
    began_s = time.monotonic()
    # Processes import the segmentation, which takes half a second, while this one looks at the recordings.
    with open_workers(count, given.scheduler, module="nurbseg.app.live.parallel") as workers:
        from nurbseg.app.batch.batch import recordings_of, run_batch
        from nurbseg.common.computer import computer, made_by, versions
        from nurbseg.common.files import create_folder

        forms = {key.removeprefix("export."): value for key, value in vars(given).items() if "export." in key}
        recordings = recordings_of(given.recordings, given.export)
        create_folder(given.export)
        by = {"scheduler": given.scheduler} if given.scheduler else {"workers": count}
        by |= {"computer": computer(), "versions": versions()}
        ended = "interrupted"
        try:
            one = "" if given.scheduler else made_by()
            run_batch(recordings, workers, config, options, ExportConfig(**forms), _tell, one)
            ended = "done"
        finally:
            _write_report(given.export / REPORT_FILE, ended, time.monotonic() - began_s, recordings, by)
    failed = [recording for recording in recordings if recording.failure]
    if failed:
        print(f"nurbseg-batch: {len(failed)} of {len(recordings)} recordings failed:", file=sys.stderr)
        for each in failed:
            print(f"  {_failure(each)}", file=sys.stderr)
    return 1 if failed else 0


def _number(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"--workers {text}: expected a number of processes of at least 1, or auto")
    return int(text)


def _refused(message: str) -> int:
    print(f"nurbseg-batch: error: {message}", file=sys.stderr)
    return 2


def _tell(recording: Recording) -> None:
    counted = f"{recording.segmented} of {recording.frames} frames segmented now"
    damaged = f", {len(recording.damaged)} damaged" if recording.damaged else ""
    if recording.without_depth:
        damaged += f", {recording.without_depth} without depth (check --depth-scale)"
    done = f"{recording.uri}: {counted}{damaged}: {recording.directory}"
    said = f"error: {_failure(recording)}" if recording.failure else done
    print(f"nurbseg-batch: {said}", file=sys.stderr, flush=True)


def _failure(recording: Recording) -> str:
    """Return a recording's failure, which names it once."""
    return f"{recording.uri}: {recording.failure.removeprefix(f'{recording.uri}: ')}"


def _write_report(
    path: Path, ended: str, seconds: float, recordings: Sequence[Recording], by: dict[str, Any]
) -> None:
    from nurbseg.common.files import write_json

    segmented = sum(recording.segmented for recording in recordings)
    document = {
        "ended": ended,
        "seconds": round(seconds, 3),
        **by,
        "complete": sum(recording.ended and not recording.failure for recording in recordings),
        "failed": sum(bool(recording.failure) for recording in recordings),
        "segmented": segmented,
        "frames_per_s": round(segmented / seconds, 3),
        "bytes_per_frame": round(sum(recording.bytes for recording in recordings) / max(segmented, 1)),
        "recordings": [asdict(recording) for recording in recordings],
    }
    write_json(path, document)
