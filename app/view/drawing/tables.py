"""Tables of a frame, as Markdown: its objects, and the segments of its tree."""

from collections import Counter

import numpy as np

from nurbseg.app.view.drawing.frame import TreeNode, ViewFrame, size_text
from nurbseg.library.palette import color_name
from nurbseg.segmentation.config import METRIC_UNITS
from nurbseg.segmentation.vocabulary import TRIED, display_name


def object_table(frame: ViewFrame) -> str:
    """Return the objects of a frame, or its segments where there are no objects, the nearest first.

    A question mark stands beside the number of what is not sure. Below the table are the reasons why surfaces
    were merged.
    """
    kind = "segments" if frame.objects is None else "objects"
    pixels, surfaces = Counter[int](), Counter[int]()
    for each in frame.tree:
        if each.label:
            thing = frame.object_of_surface[each.label]
            pixels[thing] += each.pixels
            surfaces[thing] += 1
    lines = [
        f"**{_name(frame)}**: {len(surfaces)} {kind}\n",
        f"| {kind[:-1]} | color | distance (m) | size (cm) | fit error (mm) | pixels | surfaces |",
        "|---:|---|---:|---:|---:|---:|---:|",
    ]
    if (shown := frame.measured) is not None:
        for n in np.argsort(shown.distance_m, kind="stable").tolist():
            label = int(shown.labels[n])
            cells = (
                f"{label}{'' if shown.sure[n] else '?'}",
                color_name(label),
                f"{shown.distance_m[n]:.2f}",
                size_text(shown.size_m[n]).removesuffix(" cm"),
                f"{1e3 * shown.fit_error_m[n]:.1f}" if np.isfinite(shown.fit_error_m[n]) else "",
                f"{pixels[label]:,}",
                str(surfaces[label]),
            )
            lines.append(f"| {' | '.join(cells)} |")
    if frame.merges:
        lines += ["", "Merged surfaces:", "", *(f"- {each}" for each in frame.merges)]
    return "\n".join(lines)


def tree_table(frame: ViewFrame) -> str:
    """Return the tree of a frame, a row for each segment.

    Values from an earlier frame are marked with its number: ``0.87 @12``.
    """
    nodes, moment = frame.tree, frame.moment.frame
    leaves = sum(each.label is not None for each in nodes)
    value = f"{frame.metric.upper()} ({METRIC_UNITS[frame.metric]})"
    lines = [
        f"**{_name(frame)}**: {leaves} final segments of {len(nodes)}\n",
        f"| segment | label | pixels | {value} | ratio | divided or stopped by |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for each in nodes:
        cells = (
            display_name(each.name),
            "" if each.label is None else str(each.label),
            f"{each.pixels:,}",
            "" if each.value is None else f"{each.value:.3g}" + _mark(each.measured, moment),
            "" if each.ratio is None else f"{each.ratio:.3f}" + _mark(each.judged, moment),
            _reason(each, moment),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _name(frame: ViewFrame) -> str:
    return frame.name or f"frame {frame.moment.frame}"


def _mark(found: int | None, frame: int) -> str:
    return "" if found in (None, frame) else f" @{found}"


def _reason(node: TreeNode, frame: int) -> str:
    """Return how a node is divided or why it is a leaf, and the frame of the trial that decided this."""
    by_present_values = node.stop is not None and node.stop not in TRIED
    return str(node.stop or node.division) + ("" if by_present_values else _mark(node.judged, frame))
