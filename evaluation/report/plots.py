"""Plots of scores and trees as PNG, with a color for each method and a line style for each metric."""

import io
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from nurbseg.common.code_cache import ignored_folder
from nurbseg.evaluation.results import StudyResults
from nurbseg.evaluation.scoring.frame import SCORES
from nurbseg.evaluation.variants import TREE_METHODS
from nurbseg.library.palette import STOP_COLORS
from nurbseg.library.tree_layout import tree_positions
from nurbseg.segmentation.config import Metric
from nurbseg.segmentation.vocabulary import StopReason

_INNER_COLOR = "#e4e7eb"
#: Line styles and markers of the metrics.
_LINES = ("-", "--", ":", "-.")
_MARKS = ("o", "s", "^")


def _figure(width: float, height: float, columns: int = 1) -> tuple[Any, Any]:
    """Return a figure of this size, inches, and its axes."""
    with ignored_folder():
        from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, figure.subplots(1, columns)


def _png_of(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    return buffer.getvalue()


def threshold_plot(results: StudyResults) -> bytes | None:
    """Plot each score against T, a line for each metric; None if there is only one T."""
    trees = [variant for variant in results.variants if variant.method in TREE_METHODS]
    thresholds = sorted({tree.config.ratio_max for tree in trees})
    if len(thresholds) < 2:
        return None
    figure, axes = _figure(4 * len(SCORES), 3.4, len(SCORES))
    lines = dict.fromkeys((tree.method, tree.config.metric) for tree in trees)
    methods = list(dict.fromkeys(tree.method for tree in trees))
    for axis, (score, (heading, _)) in zip(axes, SCORES.items(), strict=True):
        for method, metric in lines:
            own = {
                tree.config.ratio_max: results.mean(tree, score)
                for tree in trees
                if (tree.method, tree.config.metric) == (method, metric)
            }
            style = metric_line(metric) | {"color": f"C{methods.index(method)}"}
            axis.plot(*zip(*sorted(own.items()), strict=True), label=f"{method} {metric}", **style)
        axis.set(xlabel="T", title=heading)
        axis.grid(alpha=0.3)
    axes[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.02, 0.5))
    return _png_of(figure)


def metric_line(metric: Metric) -> dict[str, str]:
    """Return Matplotlib's unique line style of a metric."""
    number = get_args(Metric).index(metric)
    return {"linestyle": _LINES[number % len(_LINES)], "marker": _MARKS[number // len(_LINES)]}


def stop_color(stop: str) -> str:
    """Return the viewer's color of a stop reason as ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*STOP_COLORS[StopReason(stop)])


def tree_plot(segments: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw a tree as in the paper's figure 3, with leaves colored by their stop reason.

    Each segment has a ``name`` ("" for the root) and ``stop``.
    """
    names = {segment["name"] for segment in segments}
    leaves = sum(f"{name}0" not in names for name in names)
    figure, axis = _figure(max(4.0, 0.62 * leaves), 0.7 * (max(map(len, names)) + 1.4))
    children = {name: (f"{name}0", f"{name}1") for name in names if f"{name}0" in names}
    x = {name: place for name, (place, _) in tree_positions(children, "").items()}
    for segment in segments:
        name = segment["name"]
        if name:
            axis.plot([x[name], x[name[:-1]]], [-len(name), 1 - len(name)], color="#8a929c", lw=0.8, zorder=1)
        color = _INNER_COLOR if segment["stop"] is None else stop_color(segment["stop"])
        axis.scatter(x[name], -len(name), s=460, color=color, edgecolors="#5c6570", linewidths=0.6, zorder=2)
        axis.text(x[name], -len(name), f"P{name}", ha="center", va="center", fontsize=6, zorder=3)
    axis.set_axis_off()
    axis.margins(0.08, 0.15)
    return _png_of(figure)
