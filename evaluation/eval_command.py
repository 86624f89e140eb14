"""The command nurbseg-eval, which scores segmentations of labeled frames."""

import argparse
import errno
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from nurbseg.app.errors import message_handler
from nurbseg.app.parser import add_calibration_flags, add_setting_flags, command_parser
from nurbseg.common.computer import limit_blas_threads, pin_blas_kernel

_COMMANDS = ("run", "tune", "noise", "check")

_DESCRIPTION = """\
Score segmentations of labeled frames: this project's methods with any settings, and baselines.
DATA is anything that nurbseg-live replays: a folder of pairs with NAME_label.png, a recording with
ground truth, a folder with the scenes of the LTTM set, or nyu:PATH, the labeled NYU Depth v2 set or
frames of it."""

_EPILOG = """\
methods: nurbseg, stag15, pz14 (trees of surface fits), dmzc12, fh04, fh04-depth, slic-ncut, kmeans
exit codes: 0 done, 1 a failure during the run, or findings, 2 usage or no data, 130 interrupted
(Ctrl-C, SIGTERM or SIGHUP); a killed run resumes when it is started again with the same --out
example: nurbseg-eval run my_frames --methods stag15,fh04 --metrics all --thresholds 1,0.9,0.8 --out study"""


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("nurbseg-eval", _DESCRIPTION, _EPILOG)
    commands = parser.add_subparsers(dest="command", required=True, metavar="run|tune|noise|check")
    run = commands.add_parser("run", help="score methods and settings, write tables and a report")
    add = run.add_argument
    add("--methods", default="nurbseg,stag15", help="names, separated by commas (%(default)s)")
    add("--metrics", default="", help="metrics of the tree methods, or 'all' (the configured one)")
    add("--thresholds", default="", help="values of T of the tree methods (the configured one)")
    for flag, metavar, text in (
        ("--grid", "NAME=V,V", "values of any segmentation setting; lambda=auto chooses it per frame"),
        ("--labels", "DIR", "label images of another program (NAME_labels.png)"),
        (
            *("--method-from", "MODULE:FUNCTION"),
            "a method of your own: a function of the point map and a random generator that returns labels",
        ),
    ):
        add(flag, action="append", default=[], metavar=metavar, help=f"{text}; may be repeated")
    add("--out", type=Path, default=Path("out/eval"), help="folder of the study (%(default)s)")
    add("--scheduler", metavar="URL", help="a Dask scheduler, tcp://HOST:8786, instead of --jobs")
    add("--title", default="Segmentation on labeled frames", help="title of the report")
    add("--no-report", action="store_true", help="write tables only")
    add("--pictures", type=int, default=200, help="number of worst frames shown in the report (%(default)s)")
    add(
        "--time-frames", type=int, default=3, help="frames on which each variant is timed alone (%(default)s)"
    )
    tune = commands.add_parser("tune", help="search for the settings that score best")
    tune.add_argument("--budget", type=int, default=50, help="settings to try (%(default)s)")
    tune.add_argument("--folds", type=int, default=5, help="folds of the cross-validation (%(default)s)")
    tune.add_argument("--method", default=None, help="method to tune (the configured one)")
    tune.add_argument(
        "--out", type=Path, default=Path("tuned.toml"), help="configuration for nurbseg-live (%(default)s)"
    )
    noise = commands.add_parser("noise", help="measure the sensor's noise on the largest plane")
    check = commands.add_parser(
        "check", help="check an export of nurbseg-live for consistency, also with its recording"
    )
    check.add_argument(
        "folder",
        type=Path,
        metavar="DIR",
        help="folder written by nurbseg-live --export DIR --export-surfaces",
    )
    check.add_argument(
        "--frames",
        dest="recording",
        metavar="RECORDING",
        help="the recording that was segmented, from which the values are recomputed",
    )
    for each in (run, tune, noise):
        kind = "frames, labeled or not" if each is noise else "labeled frames"
        each.add_argument("data", nargs="+", metavar="DATA", help=kind)
        each.add_argument("--frames", type=int, help="maximum number of frames per source (all)")
        each.add_argument("--start", type=int, default=0, help="first frame (%(default)s)")
        each.add_argument("--seed", type=int, help="seed of all random numbers (0)")
    for each in (run, tune, noise, check):
        add_calibration_flags(each)
    for each in (run, tune):
        each.add_argument(
            "--truth",
            type=str.lower,
            choices=("labels", "joined"),
            default="labels",
            help="score against the regions as labeled, or with pieces of one object that meet in the image "
            "joined (%(default)s)",
        )
        each.add_argument(
            "--pieces",
            type=int,
            default=1,
            metavar="N",
            help="ground-truth labels stand for pieces of objects: label // N is the object, 0 the "
            "background (10 for OSD and MOSD); with 1, labels are objects, the largest is the background, "
            "and --truth joined assumes 10 (%(default)s)",
        )
        add_setting_flags(each)
        each.add_argument("--jobs", type=int, default=1, help="processes (%(default)s)")
    return parser


def command() -> int:
    """Run the command with the same matrix products on most processors; a check with those of the export."""
    if sys.argv[1:2] != ["check"]:
        pin_blas_kernel()
    return main()


def main(words: Sequence[str] | None = None) -> int:
    """Run the command in this process, by default ``run``; return its exit code."""
    limit_blas_threads()
    logging.basicConfig(handlers=[message_handler("nurbseg-eval")])
    words = list(sys.argv[1:] if words is None else words)
    if words and words[0] not in (*_COMMANDS, "-h", "--help", "--version"):
        words.insert(0, "run")
    parser = _parser()
    given = parser.parse_args(words)
    from nurbseg.common.errors import BackendMissingError, DeviceNotFoundError, DriverError, printable

    try:
        from nurbseg.evaluation import commands

        if given.command == "check":
            return commands.check(given)
        study = commands.study_of(given)
        if given.command == "run":
            commands.run(given, study, words)
        elif given.command == "tune":
            commands.search(given, study)
        else:
            commands.noise(study)
        return 0
    except (ValueError, DeviceNotFoundError, BackendMissingError) as err:
        code, text = 2, f"error: {printable(str(err))}"
    except (DriverError, OSError, RuntimeError) as err:
        file = getattr(err, "filename", None)
        if file is None and getattr(err, "errno", None) in (errno.EPIPE, errno.ENOSPC):
            # Of standard output: all files are named.
            raise
        what = f"{file}: {err.strerror}" if isinstance(err, OSError) and file else err
        code, text = 1, f"error: {printable(str(what))}"
    except ModuleNotFoundError as err:
        needed = "evaluation needs the extra 'eval': pip install '.[eval]' in the project's folder"
        code, text = 2, f"error: {err.name} is not installed; {needed}"
    except KeyboardInterrupt:
        goes_on = "; run the same command to resume" if given.command == "run" else ""
        code, text = 130, f"interrupted{goes_on}"
    print(f"nurbseg-eval: {text}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(command())
