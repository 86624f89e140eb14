"""The commands of nurbseg-eval."""

import argparse
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from tempfile import TemporaryFile
from typing import get_args

from nurbseg.app.command.config_file import format_config, read_config
from nurbseg.app.command.segmentation_arguments import base_config, source_options
from nurbseg.app.settings.app_config import AppConfig, warn_of_unread
from nurbseg.common.code_cache import ignored_folder
from nurbseg.common.computer import versions_line
from nurbseg.common.files import check_absent, write_atomically, write_json
from nurbseg.common.settings import assigned, changed_paths
from nurbseg.evaluation.check.check import FolderCheck
from nurbseg.evaluation.methods.methods import check_method
from nurbseg.evaluation.noise import measure_noise
from nurbseg.evaluation.report.findings import all_tables, as_markdown, as_text, conclusions, summary_rows
from nurbseg.evaluation.report.latex import latex_table
from nurbseg.evaluation.report.progress import Progress
from nurbseg.evaluation.report.report import write_report
from nurbseg.evaluation.results import StudyStore, write_rows, write_variants
from nurbseg.evaluation.study import (
    Study,
    first_unusable,
    frame_refs,
    readable_frames,
    run_study,
    times_per_frame,
)
from nurbseg.evaluation.truth import TRUTHS
from nurbseg.evaluation.tuning import searched_settings, tune
from nurbseg.evaluation.variants import FUNCTION_PREFIX, LABELS_PREFIX, grid_of, variants_of
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.points.registration import Registration

#: Number of sentences in the final summary.
_SUMMARY_LINES = 10


def study_of(given: argparse.Namespace) -> Study:
    """Return the study that the arguments describe, without variants."""
    leasts = {"frames": 1, "start": 0, "jobs": 1, "seed": 0, "pictures": 0, "pieces": 1}
    for name, least in leasts.items():
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
        pieces=getattr(given, "pieces", 1),
        truth=getattr(given, "truth", "labels"),
    )


def run(given: argparse.Namespace, study: Study, words: Sequence[str]) -> None:
    """Score methods and settings, and write tables and a report."""
    methods = [*_words(given.methods), *(f"{LABELS_PREFIX}{folder}" for folder in given.labels)]
    methods += [f"{FUNCTION_PREFIX}{name}" for name in given.method_from]
    for method in methods:
        check_method(method)
    base, grid = base_config(given), grid_of(given.grid)
    warn_of_unread([*changed_paths(base), *grid], methods)
    study = replace(
        study,
        variants=variants_of(
            methods,
            metrics=get_args(Metric) if given.metrics == "all" else _words(given.metrics),
            thresholds=[
                assigned(SegmentationConfig, f"threshold={word}")[1] for word in _words(given.thresholds)
            ],
            grid=grid,
            base=base,
        ),
    )
    _check_before(study, report=not given.no_report)
    store = StudyStore(given.out, study.description())
    results = run_study(study, store, jobs=given.jobs, scheduler=given.scheduler, report=Progress("frames"))
    if not results.frames:
        why = first_unusable(study)
        raise ValueError(
            f"{', '.join(study.sources)}: no frame has ground truth{why}; see {given.out}/frames"
        )
    seconds = times_per_frame(study, given.time_frames) if given.time_frames > 0 else {}
    write_json(given.out / "times.json", seconds)
    files = list(write_rows(results, given.out))
    write_variants(results, given.out)
    summary = "Each method with its first setting, and that with the best GTRC"
    tables = [(summary, summary_rows(results, seconds)), *all_tables(results, seconds)]
    about = (
        f"{len(results.frames)} frames. {TRUTHS[study.truth]}. {versions_line()}. "
        f"Computed on {'; '.join(results.computers())}."
    )
    sentences = conclusions(results)
    for caption, rows in tables:
        print(f"\n{caption}\n{as_text(rows)}")
    print(f"\n{about}")
    parts = [about, "\n".join(f"- {sentence}" for sentence in sentences)]
    parts += [f"**{caption}**\n\n{as_markdown(rows)}" for caption, rows in tables]
    files.append(given.out / "tables.md")
    write_atomically(files[-1], ("\n\n".join(parts) + "\n").encode())
    files.append(given.out / "tables.tex")
    write_atomically(files[-1], latex_table(results, seconds, about).encode())
    if not given.no_report:
        files.append(
            write_report(
                study,
                store,
                results,
                seconds,
                title=given.title,
                command=shlex.join(["nurbseg-eval", *words]),
                frames_shown=given.pictures,
            )
        )
    for frame in results.skipped:
        print(f"skipped {frame['key']}: {frame['skipped']}", file=sys.stderr)
    print("\nwritten: " + ", ".join(map(str, files)))
    print("\n" + "\n".join(sentences[:_SUMMARY_LINES]))


def _check_before(study: Study, *, report: bool) -> None:
    """Raise errors that would end the study later, before anything is written or computed."""
    with ignored_folder():
        for name in ("pyarrow", *(("jinja2", "matplotlib") if report else ())):
            import_module(name)
    if all(frame.labels is None for _, frame in readable_frames(study)):
        raise ValueError(f"{', '.join(study.sources)}: no frame has ground truth{first_unusable(study)}")


def search(given: argparse.Namespace, study: Study) -> None:
    """Search for the best settings, and write them as a configuration for nurbseg-live."""
    config = base_config(given)
    if given.method is not None:
        config = replace(config, method=given.method)
    warn_of_unread(changed_paths(config), [config.method])
    try:
        check_absent(given.out, force=True)
        TemporaryFile(dir=given.out.parent).close()
    except OSError as err:
        raise ValueError(f"--out {given.out}: cannot be written: {err.strerror}") from err
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
    for path, value in searched_settings(found.config).items():
        print(f"{path.rpartition('.')[2]} = {value}")
    gain = found.gain
    print(f"{TRUTHS[study.truth]}.")
    print(
        f"objective {found.objective:.4f} on all frames (GTRC - VoI / 10); gain on held-out frames "
        f"{gain.mean:+.4f}, 95 % interval {gain.low:+.4f} to {gain.high:+.4f}, "
        f"{gain.frames} frames"
    )
    if gain.low <= 0:
        print(
            "the interval includes 0: more frames are needed to distinguish these settings from the "
            "previous ones"
        )
    print(f"written: {given.out} (use it with nurbseg-live --config {given.out})")


def noise(study: Study) -> None:
    """Measure the sensor's noise on the largest plane."""
    frames = readable_frames(study, report=lambda err: print(f"nurbseg-eval: {err}", file=sys.stderr))
    registration = Registration()
    estimate = measure_noise((registration.register(frame) for _, frame in frames), seed=study.seed)
    print(f"inverse_depth_noise = {estimate.inverse_depth_noise:.6f}")
    print(
        f"from {estimate.points} points on planes in {estimate.frames} of {len(frame_refs(study))} frames; "
        f"{estimate.nearest_per_m:.6f} 1/m at {estimate.nearest_m:.2f} m, "
        f"{estimate.farthest_per_m:.6f} 1/m at {estimate.farthest_m:.2f} m"
    )


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def check(given: argparse.Namespace) -> int:
    """Print findings on a folder of exports and what was checked; return 1 if there are findings."""
    options = source_options(given)
    started_s = time.perf_counter()
    folder = FolderCheck(given.folder, given.recording, options)
    count = 0
    for finding in folder.findings():
        count += 1
        print(finding)
    per_frame_ms = 1e3 * (time.perf_counter() - started_s) / max(folder.frames, 1)
    numbers = ((count, "finding"), (folder.frames, "frame"), (folder.segments, "segment"))
    findings, frames, segments = (f"{number} {what}{'s' * (number != 1)}" for number, what in numbers)
    unchecked = f"{folder.unchecked} values and trials of missing frames not checked; "
    print(
        f"{findings} in {frames} with {segments}; {folder.recomputed} surfaces compared with their points; "
        f"{unchecked if folder.unchecked else ''}{per_frame_ms:.0f} ms per frame",
        file=sys.stderr,
    )
    return 1 if count else 0
