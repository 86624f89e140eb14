"""Pictures of frames and segmentations, and plots of scores, as PNG and JPEG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.evaluation.results import StudyResults
from nurbseg.app.evaluation.scoring import SCORES
from nurbseg.app.view.drawing.palette import STOP_COLORS
from nurbseg.segmentation.vocabulary import StopReason

_INNER_COLOR = "#e4e7eb"
_JPEG_QUALITY = 85


def label_colors(labels: NDArray[np.integer], truth: NDArray[np.integer] | None = None) -> NDArray[np.uint8]:
    """Color a label map; segments that overlap a ground-truth region most bear its color.

    Parameters
    ----------
    labels : (H, W) integer
        0 becomes black.
    truth : (H, W) integer, optional
        With it, the largest overlap of a region and a segment shares the region's color; other segments
        get colors that no region has.

    Returns
    -------
    (H, W, 3) uint8
        RGB.
    """
    colors = np.zeros((*labels.shape, 3), np.uint8)
    values = np.unique(labels[labels > 0])
    number = {int(value): place for place, value in enumerate(values)}
    if truth is not None:
        number = _matched(labels, truth, values)
    for value, place in number.items():
        colors[labels == value] = _distinct_color(place)
    return colors


def _matched(
    labels: NDArray[np.integer], truth: NDArray[np.integer], values: NDArray[np.integer]
) -> dict[int, int]:
    regions = np.unique(truth[truth > 0])
    both = (labels > 0) & (truth > 0)
    rows = np.searchsorted(values, labels[both])
    columns = np.searchsorted(regions, truth[both])
    overlap = np.bincount(
        rows * max(len(regions), 1) + columns, minlength=len(values) * max(len(regions), 1)
    ).reshape(len(values), -1)
    number: dict[int, int] = {}
    while overlap.size and overlap.max() > 0:
        row, column = np.unravel_index(int(overlap.argmax()), overlap.shape)
        number[int(values[row])] = int(column)
        overlap[row], overlap[:, column] = 0, 0
    for place, value in enumerate(set(map(int, values)) - set(number)):
        number[value] = len(regions) + place
    return number


def _distinct_color(number: int) -> NDArray[np.uint8]:
    """Color of a number: hues by the golden ratio, in three tones."""
    hue = int(180 * (0.61 + number * 0.618034) % 180)
    saturation, value = ((170, 235), (110, 250), (225, 170))[number // 3 % 3]
    tone = np.array([[[hue, saturation, value]]], dtype=np.uint8)
    return np.asarray(cv2.cvtColor(tone, cv2.COLOR_HSV2RGB)[0, 0], dtype=np.uint8)


def depth_colors(depth_mm: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Color a depth image from near (yellow) to far (violet), (H, W, 3) uint8 RGB; black without depth."""
    known = depth_mm > 0
    if not known.any():
        return np.zeros((*depth_mm.shape, 3), np.uint8)
    near, far = np.percentile(depth_mm[known], (1, 99))
    share = np.clip((far - depth_mm.astype(np.float32)) / max(far - near, 1.0), 0.0, 1.0)
    colors = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[:, :, ::-1].copy()
    colors[~known] = 0
    return np.asarray(colors, dtype=np.uint8)


def error_colors(residual_m: NDArray[np.floating[Any]], most_m: float) -> NDArray[np.uint8]:
    """Color residuals as the paper's figure 2, blue at 0 to red at `most_m`; black where NaN."""
    known = np.isfinite(residual_m)
    share = np.clip(np.nan_to_num(residual_m) / most_m, 0.0, 1.0)
    colors = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_JET)[:, :, ::-1].copy()
    colors[~known] = 0
    return np.asarray(colors, dtype=np.uint8)


def tile(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Scale an RGB image to a width, pixels averaged, so that thin borders remain."""
    height = round(image.shape[0] * width / image.shape[1])
    method = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), dtype=np.uint8)


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """Encode an RGB image as JPEG."""
    return bytes(cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def strip_png(tiles: Sequence[tuple[str, NDArray[np.uint8]]], width: int = 240) -> bytes:
    """Put captioned pictures side by side, as a row of the paper's figure 4.

    Parameters
    ----------
    tiles : sequence of (str, (H, W, 3) uint8)
        Captions and RGB images of one shape.
    width : int
        Of each, pixels.

    Returns
    -------
    bytes
        PNG.
    """
    columns = []
    for caption, image in tiles:
        small = tile(image, width)
        head = np.full((22, width, 3), 255, np.uint8)
        cv2.putText(head, caption[:38], (3, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
        columns.append(np.vstack([head, small]))
        columns.append(np.full((columns[-1].shape[0], 4, 3), 255, np.uint8))
    return bytes(cv2.imencode(".png", np.hstack(columns[:-1])[:, :, ::-1])[1])


def _png_of(figure: Any) -> bytes:
    from matplotlib import pyplot

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    pyplot.close(figure)
    return buffer.getvalue()


def _plotter() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    return pyplot


def threshold_plot(results: StudyResults) -> bytes | None:
    """Plot each score against T, a line for each metric; None where there is only one T."""
    trees = [each for each in results.variants if each.method in ("stag15", "nurbseg")]
    thresholds = sorted({each.config.ratio_max for each in trees})
    if len(thresholds) < 2:
        return None
    pyplot = _plotter()
    figure, axes = pyplot.subplots(1, len(SCORES), figsize=(4 * len(SCORES), 3.4))
    lines = dict.fromkeys((each.method, each.config.metric) for each in trees)
    for axis, (score, (heading, _)) in zip(axes, SCORES.items(), strict=True):
        for method, metric in lines:
            own = {
                each.config.ratio_max: results.mean(each, score)
                for each in trees
                if (each.method, each.config.metric) == (method, metric)
            }
            axis.plot(sorted(own), [own[t] for t in sorted(own)], marker="o", label=f"{method} {metric}")
        axis.set(xlabel="T", title=heading)
        axis.grid(alpha=0.3)
    axes[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.02, 0.5))
    return _png_of(figure)


def category_plot(results: StudyResults) -> bytes | None:
    """Plot the covering of each variant by category as bars with intervals; None for one category."""
    categories = results.categories()
    shown = leaders(results)
    if len(categories) < 2:
        return None
    pyplot = _plotter()
    figure, axis = pyplot.subplots(figsize=(max(6.0, 2.2 * len(categories)), 3.6))
    step = 0.8 / len(shown)
    for place, variant in enumerate(shown):
        found = [results.estimate(variant, "gtrc", each) for each in categories]
        means = np.array([each.mean for each in found])
        errors = np.abs(np.array([[each.low, each.high] for each in found]).T - means)
        at = np.arange(len(categories)) - 0.4 + step * (place + 0.5)
        axis.bar(at, means, step, yerr=errors, label=variant.name, error_kw={"linewidth": 0.8})
    axis.set(xticks=np.arange(len(categories)), xticklabels=categories, ylabel="GTRC")
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5))
    return _png_of(figure)


def time_plot(results: StudyResults, seconds: Mapping[str, float]) -> bytes | None:
    """Plot covering against time per frame, a point for each timed variant; None without times."""
    timed = [each for each in results.variants if each.name in seconds]
    if not timed:
        return None
    pyplot = _plotter()
    figure, axis = pyplot.subplots(figsize=(6.5, 4))
    named = {each.name for each in leaders(results)}
    for variant in timed:
        at = 1000 * seconds[variant.name], results.mean(variant, "gtrc")
        axis.plot(*at, "o", color="tab:blue" if variant.method in ("nurbseg", "stag15") else "tab:gray")
        if variant.name in named:
            axis.annotate(variant.name, at, fontsize=7, xytext=(4, 3), textcoords="offset points")
    axis.set(xscale="log", xlabel="time per frame (ms)", ylabel="GTRC")
    axis.grid(alpha=0.3)
    return _png_of(figure)


def leaders(results: StudyResults) -> list[Any]:
    """Return the variant with the best covering of each method, in the order of the tables."""
    best: dict[str, Any] = {}
    for variant in results.variants:
        held = best.get(variant.method)
        if held is None or (results.mean(variant, "gtrc") > results.mean(held, "gtrc")):
            best[variant.method] = variant
    return [each for each in results.variants if best[each.method] is each]


def stop_color(stop: str) -> str:
    """Return the viewer's color of a leaf that stopped for this reason, as ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*STOP_COLORS[StopReason(stop)])


def tree_plot(segments: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw a segmentation tree as the paper's figure 3: leaves filled by the reason why they are leaves.

    Parameters
    ----------
    segments : sequence of mapping
        ``name`` ("" for the root), ``stop`` and ``size`` of each segment.
    """
    pyplot = _plotter()
    names = [each["name"] for each in segments]
    leaves = sorted(name for name in names if f"{name}0" not in names)
    x = {name: float(place) for place, name in enumerate(leaves)}
    for name in sorted(set(names) - set(leaves), key=len, reverse=True):
        x[name] = (x[f"{name}0"] + x[f"{name}1"]) / 2
    deepest = max(map(len, names))
    figure, axis = pyplot.subplots(figsize=(max(4.0, 0.62 * len(leaves)), 0.7 * (deepest + 1.4)))
    for each in segments:
        name = each["name"]
        if name:
            axis.plot([x[name], x[name[:-1]]], [-len(name), 1 - len(name)], color="#8a929c", lw=0.8, zorder=1)
        stop = each["stop"]
        color = _INNER_COLOR if stop is None else stop_color(stop)
        axis.scatter(x[name], -len(name), s=460, color=color, edgecolors="#5c6570", linewidths=0.6, zorder=2)
        axis.text(x[name], -len(name), f"P{name}", ha="center", va="center", fontsize=6, zorder=3)
    axis.set_axis_off()
    axis.margins(0.08, 0.15)
    return _png_of(figure)
