"""What each stage of the default method is worth: scores as they are added, and as each is left out.

Examples
--------
Labeled frames without calibration, as docs/ablation.md::

    python benchmarks/ablation.py FOLDER FOLDER --intrinsics 525,525,319.5,239.5 --out docs/ablation.md
"""

from __future__ import annotations

import datetime
import platform
import shlex
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from labelled import frames_parser, labelled_frames
from numpy.typing import NDArray

from nurbseg.common.frame import RGBDFrame
from nurbseg.common.settings import updated
from nurbseg.evaluation.results import bootstrap_mean
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, register
from nurbseg.segmentation.vocabulary import StopReason

SCORES = (
    ("GTRC", Contingency.region_covering),
    ("VoI", Contingency.variation_of_information),
    ("obj", Contingency.object_iou),
)
#: Settings of `ExtendedConfig` that turn each stage off, in the order in which the ladder adds the stages.
STAGES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("merging into objects", {"merge_surfaces": False}),
    ("normals in the vectors, color x 0.25", {"normal_weight": 0.0, "color_weight": 1.0}),
    ("the floor of noise for metrics", {"noise_floor": 0.0}),
    ("further eigenvectors", {"cuts": 1}),
    ("border refinement", {"refine_borders": False}),
    ("folding of surfaces", {"fold_surfaces": False}),
    ("creases", {"split_creases": False}),
    ("protrusions", {"protrusion_min": 0.0}),
)
#: Metrics and thresholds of the table of decisions.
METRICS: tuple[Metric, ...] = ("mse", "nle", "vmec")
THRESHOLDS = (1.0, 0.9, 0.7)
#: Left out as well: every split that is tried is kept.
NO_RATIO = ("the ratio (every split is kept)", {"ratio_max": 1e9})

Frames = Sequence[tuple[PointMap, NDArray[np.uint16]]]


def registered(frames: Iterable[RGBDFrame]) -> Frames:
    """Register every frame that has labels."""
    return [(register(frame), frame.labels) for frame in frames if frame.labels is not None]


def measured(
    frames: Frames, config: SegmentationConfig, decided: Counter[str] | None = None
) -> NDArray[np.float64]:
    """Score a setting on every frame: (frames, 3 scores + objects + leaves + milliseconds).

    Counts leaves by their stop reasons, and splits that the ratio accepted and rejected, in `decided`.
    """
    rows = []
    for cloud, truth in frames:
        started_s = time.perf_counter()
        tree = segment(cloud, config)
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        labels = tree.labels()
        table = Contingency.between(labels, truth)
        scores = [score(table) for _, score in SCORES]
        rows.append([*scores, float(labels.max()), float(len(tree.leaves())), elapsed_ms])
        if decided is not None:
            decided.update(str(leaf.stop) for leaf in tree.leaves())
            trials = [each.trial for each in tree.segments if each.trial is not None]
            decided.update("accepted" if trial.kept else "rejected" for trial in trials)
    return np.array(rows)


def ladder() -> Iterable[tuple[str, SegmentationConfig]]:
    """Yield settings that add one stage after the other."""
    default = SegmentationConfig()
    off = {name: value for _, settings in STAGES for name, value in settings.items()}
    bare = updated(default, extended=off)
    yield "pieces at depth gaps, no cut", replace(bare, splits_max=0)
    yield "0 the paper (stag15)", replace(default, method="stag15")
    yield "1 its tree, with pieces at gaps and fits of inverse depth", bare
    for number, (name, settings) in enumerate(STAGES, start=2):
        for setting in settings:
            off.pop(setting)
        yield f"{number} + {name}", updated(default, extended=off)


def line(name: str, values: NDArray[np.float64], reference: NDArray[np.float64] | None = None) -> str:
    """Lay out one row of a table: each score, or its difference to a reference with its interval."""
    cells = [name]
    for column in range(len(SCORES)):
        if reference is None:
            cells.append(f"{values[:, column].mean():.4f}")
        else:
            gain = bootstrap_mean(values[:, column] - reference[:, column])
            cells.append(f"{gain.mean:+.4f} [{gain.low:+.4f}, {gain.high:+.4f}]")
    cells += [f"{values[:, -3].mean():.1f}", f"{values[:, -2].mean():.1f}", f"{np.median(values[:, -1]):.0f}"]
    return "| " + " | ".join(cells) + " |"


def header(first: str) -> list[str]:
    """Return the first two lines of a table."""
    names = [first, *(name for name, _ in SCORES), "segments", "leaves", "ms a frame"]
    return ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]


def decisions(frames: Frames) -> list[str]:
    """Lay out what the ratio decided, by metric and threshold."""
    names = ["metric", *(name for name, _ in SCORES), "judged", "accepted", "rejected", "noise"]
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    for metric in METRICS:
        for threshold in THRESHOLDS:
            decided: Counter[str] = Counter()
            config = SegmentationConfig(metric=metric, ratio_max=threshold)
            scores = measured(frames, config, decided)[:, : len(SCORES)].mean(axis=0)
            accepted, rejected = decided["accepted"], decided["rejected"]
            counts = [accepted + rejected, accepted, rejected, decided[str(StopReason.NOISE)]]
            cells = [f"{metric}, T = {threshold:g}", *(f"{score:.4f}" for score in scores), *map(str, counts)]
            lines.append("| " + " | ".join(cells) + " |")
            print(cells[0], np.round(scores, 4), file=sys.stderr, flush=True)
    return lines


def left_out(frames: Frames, whole: NDArray[np.float64]) -> list[str]:
    """Lay out what each stage is worth where all others stay."""
    lines = header("without")
    for name, settings in (*((stage, {"extended": off}) for stage, off in STAGES), NO_RATIO):
        values = measured(frames, updated(SegmentationConfig(), **settings))
        print(
            "without", name, np.round(values[:, : len(SCORES)].mean(axis=0), 4), file=sys.stderr, flush=True
        )
        lines.append(line(name, values, whole))
    return lines


def report(named: Sequence[tuple[str, Frames]], seeds: int, command: str) -> list[str]:
    """Measure everything; returns the lines of a page, and tells of progress on the error stream."""
    frames = named[0][1]

    def run(name: str, config: SegmentationConfig) -> NDArray[np.float64]:
        values = measured(frames, config)
        print(name, np.round(values[:, : len(SCORES)].mean(axis=0), 4), file=sys.stderr, flush=True)
        return values

    lines = [
        "# What each stage is worth",
        "",
        f"Made by `{command}`",
        f"on {datetime.date.today()}, on the {len(frames)} labeled frames of {named[0][0]} unless a table",
        "names others, at full resolution, with seed 0 and the default settings except for what a row says.",
        "Scores are means over frames, by the labels as they are; GTRC and obj are better when higher, VoI",
        "(bits) when lower.",
        "Milliseconds are the median of one pass beside other work; times alone are in performance.md.",
        f"{platform.python_implementation()} {platform.python_version()}, NumPy {np.__version__}, "
        f"SciPy {scipy.__version__}, OpenCV {cv2.__version__}.",
        "",
        "## One after the other",
        "",
        *header("each row adds one stage"),
    ]
    full = np.zeros(0)
    for name, config in ladder():
        full = run(name, config)
        lines.append(line(name, full))
    lines += [
        "",
        "## Each left out",
        "",
        "Differences from the complete method, frame by frame, with bootstrap 95 % intervals. Without the",
        "floor of noise the paper's ratio stands alone.",
        "",
        *left_out(frames, full),
    ]
    for name, others in named[1:]:
        whole = measured(others, SegmentationConfig())
        lines += ["", f"The same on the {len(others)} frames of {name}, where the complete method scores", ""]
        lines += [*header("with"), line("all stages", whole), "", *left_out(others, whole)]
    lines += [
        "",
        "## What the ratio decides",
        "",
        "Splits that the ratio judged, those it accepted and rejected, and leaves that stopped by `noise`,",
        "summed over all frames. No split of these was tried: their metric is so close to its floor of noise",
        "that no split can have a ratio below T.",
    ]
    for name, each in named:
        lines += ["", f"{name}, {len(each)} frames:", "", *decisions(each)]
    means = [full[:, : len(SCORES)].mean(axis=0)]
    for seed in range(1, seeds):
        values = run(f"seed {seed}", replace(SegmentationConfig(), seed=seed))
        means.append(values[:, : len(SCORES)].mean(axis=0))
    average, spread = np.mean(means, axis=0), np.std(means, axis=0)
    summary = ", ".join(
        f"{name} {mean:.4f} ± {deviation:.4f}"
        for (name, _), mean, deviation in zip(SCORES, average, spread, strict=True)
    )
    told = f"Mean and standard deviation of the complete method over {seeds} seeds, {named[0][0]}: {summary}."
    return [*lines, "", "## Seeds", "", told, ""]


def main() -> None:
    """Run from the command line."""
    parser = frames_parser(__doc__, "labeled frames: folders of pairs or recordings")
    parser.add_argument("--out", type=Path, help="page to write; the terminal without it")
    given = parser.parse_args()
    named = [(Path(frame).name, registered(labelled_frames(frame, given))) for frame in given.frames]
    words = [Path(word).name if word in given.frames else word for word in sys.argv[1:]]
    page = "\n".join(report(named, given.seeds, shlex.join(["python", "benchmarks/ablation.py", *words])))
    if given.out:
        given.out.write_text(page)
    else:
        print(page)


if __name__ == "__main__":
    main()
