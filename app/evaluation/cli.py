"""nurbseg-eval: how good segmentations of labelled frames are, beside their rivals and by their settings."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nurbseg.app.command.threads import one_thread_for_products
from nurbseg.app.evaluation.check.command import add_arguments, check_command
from nurbseg.app.evaluation.computer import same_products_everywhere
from nurbseg.app.evaluation.progress import Progress

if TYPE_CHECKING:
    from nurbseg.app.evaluation.study import Study
    from nurbseg.drivers.options import SourceOptions
    from nurbseg.segmentation.config import SegmentationConfig

_COMMANDS = ("run", "tune", "noise", "check")
_METRICS = "mse,mae,ve,nle,vmxc,vmec,vgc,mmxc,nlc"

_DESCRIPTION = """\
Score segmentations of labelled frames: the methods of this project with any settings, and their rivals.
DATA is what nurbseg-live replays: a folder of pairs with NAME_label.png, a recording with ground truth,
"synthetic:", the labelled NYU Depth v2 set or frames of it, or a folder with the scenes of the LTTM set."""

_EPILOG = """\
methods: nurbseg, stag15, pz14 (trees of surface fits), dmzc12, fh04, fh04-depth, slic-ncut, kmeans,
lccp and pcl-organized (with Debian's libpcl-dev, cmake and g++)
exit codes: 0 done, 1 failed while running or findings, 2 usage or no data, 130 interrupted; a killed run
goes on where it was when it is started again with the same --out
example: nurbseg-eval run my_frames --methods stag15,fh04 --metrics all --thresholds 1,0.9,0.8 --out study"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nurbseg-eval",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="run|tune|noise|check")
    run = commands.add_parser("run", help="score methods and settings, write tables and a report")
    run.add_argument("--methods", default="nurbseg,stag15", help="names, separated by commas (%(default)s)")
    run.add_argument(
        "--metrics", default="", help="metrics of the tree methods, or 'all' (the configured one)"
    )
    run.add_argument("--thresholds", default="", help="values of T of the tree methods (the configured one)")
    run.add_argument(
        "--grid",
        action="append",
        default=[],
        metavar="NAME=V,V",
        help="values of any segmentation setting; lambda=auto chooses it for each frame; may be repeated",
    )
    run.add_argument(
        "--labels",
        action="append",
        default=[],
        metavar="DIR",
        help="label images of another program (NAME_labels.png); may be repeated",
    )
    run.add_argument("--out", type=Path, default=Path("out/eval"), help="folder of the study (%(default)s)")
    run.add_argument(
        "--scheduler", metavar="URL", help="a Dask scheduler, tcp://HOST:8786, in place of --jobs"
    )
    run.add_argument("--title", default="Segmentation on labelled frames", help="of the report")
    run.add_argument("--no-report", action="store_true", help="write tables only")
    run.add_argument(
        "--pictures", type=int, default=200, help="frames shown in the report, the worst ones (%(default)s)"
    )
    run.add_argument(
        "--time-frames", type=int, default=3, help="frames on which each variant is timed alone (%(default)s)"
    )
    tune = commands.add_parser("tune", help="search the settings that score best")
    tune.add_argument("--budget", type=int, default=50, help="settings to try (%(default)s)")
    tune.add_argument("--folds", type=int, default=5, help="parts of the cross-validation (%(default)s)")
    tune.add_argument("--method", default=None, help="method to tune (the configured one)")
    tune.add_argument(
        "--out", type=Path, default=Path("tuned.toml"), help="configuration for nurbseg-live (%(default)s)"
    )
    noise = commands.add_parser("noise", help="measure the sensor's noise on the largest plane")
    check = commands.add_parser(
        "check", help="hold what nurbseg-live exported against itself and its recording"
    )
    add_arguments(check)
    for each in (run, tune, noise):
        kind = "frames, labelled or not" if each is noise else "labelled frames"
        each.add_argument("data", nargs="+", metavar="DATA", help=kind)
        each.add_argument("--frames", type=int, help="frames of each source at the most (all)")
        each.add_argument("--start", type=int, default=0, help="first frame (%(default)s)")
        each.add_argument("--seed", type=int, help="of all that draws random numbers (0)")
    for each in (run, tune, noise, check):
        each.add_argument("--intrinsics", metavar="FX,FY,CX,CY", help="of data without calibration, pixels")
        each.add_argument("--depth-scale", type=float, help="depth units per metre of data that does not say")
    for each in (run, tune):
        each.add_argument("--config", type=Path, metavar="FILE", help="read settings from a TOML file")
        each.add_argument(
            "--set",
            dest="settings",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help="a segmentation setting; may be repeated",
        )
        each.add_argument("--jobs", type=int, default=1, help="processes (%(default)s)")
    return parser


def command() -> int:
    """Run the command in a process of its own, with the same matrix products on most processors.

    Returns
    -------
    int
        As `main`.
    """
    same_products_everywhere()
    return main()


def main(words: Sequence[str] | None = None) -> int:
    """Run the command in this process.

    Parameters
    ----------
    words : sequence of str, optional
        The arguments; the process's own by default. Without a command the first is ``run``.

    Returns
    -------
    int
        Exit code: 0 done, 1 failed while running or findings, 2 usage or no data, 130 interrupted.
    """
    one_thread_for_products()
    words = list(sys.argv[1:] if words is None else words)
    if words and words[0] not in (*_COMMANDS, "-h", "--help"):
        words.insert(0, "run")
    parser = _parser()
    given = parser.parse_args(words)
    from nurbseg.drivers.errors import BackendMissingError, DeviceNotFoundError, DriverError

    try:
        if given.command == "check":
            return check_command(given, source_options(given))
        study = _study(given)
        if given.command == "run":
            _run(given, study, base_config(given), words)
        elif given.command == "tune":
            _tune(given, study, base_config(given))
        else:
            _noise(study)
    except (ValueError, DeviceNotFoundError, BackendMissingError) as err:
        print(f"nurbseg-eval: {err}", file=sys.stderr)
        return 2
    except (DriverError, OSError, RuntimeError) as err:
        print(f"nurbseg-eval: {err}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as err:
        print(
            f"nurbseg-eval: {err.name} is not installed; evaluation needs the extra 'eval': "
            "pip install '.[eval]' in the project's folder",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        goes_on = "; the same command goes on from here" if given.command == "run" else ""
        print(f"nurbseg-eval: interrupted{goes_on}", file=sys.stderr)
        return 130
    return 0


def _study(given: argparse.Namespace) -> Study:
    from nurbseg.app.evaluation.study import Study

    for name, least in (("frames", 1), ("start", 0), ("jobs", 1), ("seed", 0), ("pictures", 0)):
        value = getattr(given, name, None)
        if value is not None and value < least:
            raise ValueError(f"--{name}: expected at least {least}, got {value}")
    return Study(
        sources=tuple(given.data),
        variants=(),
        options=source_options(given),
        seed=given.seed or 0,
        frames=given.frames,
        start=given.start,
    )


def source_options(given: argparse.Namespace) -> SourceOptions:
    """Return what the arguments say of recordings that do not say it themselves."""
    from nurbseg.drivers.options import SourceOptions

    intrinsics = None
    if given.intrinsics is not None:
        try:
            fx, fy, cx, cy = (float(each) for each in given.intrinsics.split(","))
        except ValueError:
            raise ValueError(f"--intrinsics {given.intrinsics}: expected FX,FY,CX,CY in pixels") from None
        intrinsics = (fx, fy, cx, cy)
    return SourceOptions(intrinsics=intrinsics, depth_scale=given.depth_scale)


def base_config(given: argparse.Namespace) -> SegmentationConfig:
    """Return the settings of the segmentation that the arguments give."""
    from nurbseg.app.command.config_file import read_config
    from nurbseg.app.evaluation.variants import path_named, setting_value
    from nurbseg.drivers.settings import nested, updated
    from nurbseg.segmentation.config import SegmentationConfig

    config = SegmentationConfig() if given.config is None else read_config(given.config).segmentation
    chosen: dict[str, Any] = {} if given.seed is None else {"seed": given.seed}
    for text in given.settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"--set {text}: expected NAME=VALUE")
        chosen[path_named(name)] = setting_value(name, value)
    result: SegmentationConfig = updated(config, **nested(chosen))
    return result


def _run(given: argparse.Namespace, study: Study, config: SegmentationConfig, words: Sequence[str]) -> None:
    from datetime import UTC, datetime

    from nurbseg.app.evaluation.computer import versions_line
    from nurbseg.app.evaluation.methods.methods import check_method
    from nurbseg.app.evaluation.report.findings import findings, means_of
    from nurbseg.app.evaluation.report.report import write_report
    from nurbseg.app.evaluation.report.tables import all_tables, as_markdown, as_text
    from nurbseg.app.evaluation.results import StudyResults, write_rows
    from nurbseg.app.evaluation.store import StudyStore, write_json
    from nurbseg.app.evaluation.study import run_study, times_per_frame
    from nurbseg.app.evaluation.variants import LABELS_PREFIX, grid_of, variants_of

    methods = [*_words(given.methods), *(f"{LABELS_PREFIX}{folder}" for folder in given.labels)]
    for method in methods:
        check_method(method)
    try:
        thresholds = [float(each) for each in _words(given.thresholds)]
    except ValueError:
        raise ValueError(f"--thresholds {given.thresholds}: expected numbers, separated by commas") from None
    study = replace(
        study,
        variants=variants_of(
            methods,
            metrics=_words(_METRICS if given.metrics == "all" else given.metrics),
            thresholds=thresholds,
            grid=grid_of(given.grid),
            base=config,
        ),
    )
    store = StudyStore(given.out, study.description())
    refs = run_study(study, store, jobs=given.jobs, scheduler=given.scheduler, report=Progress("frames"))
    results = StudyResults.load(store, study.variants, {ref.key for ref in refs})
    if not results.frames:
        raise ValueError(f"{', '.join(study.sources)}: no frame has ground truth; see {given.out}/frames")
    seconds = times_per_frame(study, given.time_frames) if given.time_frames > 0 else {}
    write_json(given.out / "times.json", dict(seconds))
    files = list(write_rows(results, given.out))
    tables = all_tables(results, seconds)
    about = f"{len(results.frames)} frames. {versions_line()}. Computed on {'; '.join(results.computers())}."
    sentences = findings(means_of(results))
    for caption, rows in tables:
        print(f"\n{caption}\n{as_text(rows)}")
    print(f"\n{about}")
    markdown = given.out / "tables.md"
    parts = [about, "\n".join(f"- {each}" for each in sentences)]
    parts += [f"**{caption}**\n\n{as_markdown(rows)}" for caption, rows in tables]
    markdown.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    files.append(markdown)
    if not given.no_report:
        files.append(
            write_report(
                study,
                store,
                results,
                seconds,
                title=given.title,
                command=shlex.join(["nurbseg-eval", *words]),
                date=datetime.now(UTC).date().isoformat(),
                frames_shown=given.pictures,
            )
        )
    for frame in results.skipped:
        print(f"skipped {frame['key']}: {frame['skipped']}", file=sys.stderr)
    print("\nwritten: " + ", ".join(map(str, files)))


def _tune(given: argparse.Namespace, study: Study, config: SegmentationConfig) -> None:
    from nurbseg.app.atomic_file import write_atomically
    from nurbseg.app.command.config_file import format_config, read_config
    from nurbseg.app.config import AppConfig
    from nurbseg.app.evaluation.tuning import tunable, tune

    if given.method is not None:
        config = replace(config, method=given.method)
    if not given.out.parent.is_dir():
        raise ValueError(f"--out {given.out}: no such folder")
    progress = Progress("settings")
    found = tune(
        study,
        config,
        budget=given.budget,
        folds=given.folds,
        jobs=given.jobs,
        seed=given.seed or 0,
        report=lambda done, best: progress(done, given.budget, f"best {best:.4f}"),
    )
    before = AppConfig() if given.config is None else read_config(given.config)
    write_atomically(given.out, format_config(replace(before, segmentation=found.config)).encode())
    for name, value in tunable(found.config):
        print(f"{name} = {value}")
    gain = found.gain
    print(
        f"objective {found.objective:.4f} on all frames (GTRC - VoI / 10); gain on frames without part in "
        f"the choice {gain.mean:+.4f}, 95 % interval {gain.low:+.4f} to {gain.high:+.4f}, "
        f"{gain.frames} frames"
    )
    if gain.low <= 0:
        print("the interval holds 0: more frames are needed to tell these settings from those before")
    print(f"written: {given.out} (use it with nurbseg-live --config {given.out})")


def _noise(study: Study) -> None:
    from nurbseg.app.evaluation.study import frame_refs, read_frame
    from nurbseg.drivers.errors import FrameFormatError
    from nurbseg.segmentation.points.registration import PointMap, register
    from nurbseg.segmentation.surfaces.noise import measure_noise

    def clouds() -> Iterator[PointMap]:
        for ref in refs:
            try:
                yield register(read_frame(ref, study.options))
            except FrameFormatError as err:
                print(f"nurbseg-eval: {err}", file=sys.stderr)

    refs = frame_refs(study)
    estimate = measure_noise(clouds(), seed=study.seed)
    print(f"inverse_depth_noise = {estimate.inverse_depth_noise:.6f}")
    print(
        f"from {estimate.points} points on planes in {estimate.frames} of {len(refs)} frames; "
        f"{estimate.nearest_per_m:.6f} 1/m at {estimate.nearest_m:.2f} m, "
        f"{estimate.farthest_per_m:.6f} 1/m at {estimate.farthest_m:.2f} m"
    )


def _words(text: str) -> list[str]:
    return [each.strip() for each in text.split(",") if each.strip()]


if __name__ == "__main__":
    sys.exit(command())
