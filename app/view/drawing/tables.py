"""Tables of a frame, as Markdown: its objects, and the segments of its tree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.objects import OrientedBox
from nurbseg.app.view.drawing.frame import TreeNode, ViewFrame
from nurbseg.app.view.drawing.palette import color_name
from nurbseg.app.view.drawing.tree import display_name
from nurbseg.segmentation.config import Metric
from nurbseg.segmentation.segments import TRIED

_METRIC_UNITS: dict[Metric, str] = {
    "mse": "m²",
    "mae": "m",
    "ve": "m²",
    "nle": "points",
    "vmxc": "1/m²",
    "vmec": "1/m²",
    "vgc": "1/m⁴",
    "mmxc": "1/m",
    "nlc": "points",
}

#: Fewest shown points of an object whose size is told.
_LEAST_POINTS = 10
#: Most points of an object that its size is told from: more take too long beside a camera.
_BOX_POINTS = 200


def object_table(frame: ViewFrame) -> str:
    """Return the objects of a frame, or its segments where there are no objects, the largest first.

    Distance and size are those of the points that are shown: of their mean, and of their oriented box. Below
    it, why surfaces were merged.
    """
    kind = "segments" if frame.objects is None else "objects"
    object_of_surface = frame.object_of_surface
    pixels: dict[int, int] = {}
    surfaces: dict[int, int] = {}
    for each in frame.tree:
        if each.label:
            thing = object_of_surface[each.label]
            pixels[thing] = pixels.get(thing, 0) + each.pixels
            surfaces[thing] = surfaces.get(thing, 0) + 1
    lookup = np.zeros(max(object_of_surface, default=0) + 1, dtype=np.uint16)
    lookup[[*object_of_surface]] = [*object_of_surface.values()]
    object_of_vertex = lookup[frame.vertex_surfaces]
    lines = [
        f"**{_name(frame)}**: {len(pixels)} {kind}\n",
        f"| {kind[:-1]} | color | pixels | distance (m) | size (m) | fit error (mm) | surfaces |",
        "|---:|---|---:|---:|---|---:|---:|",
    ]
    for thing in sorted(pixels, key=lambda each: (-pixels[each], each)):
        distance, size = _place(frame.points_m[frame.point_labels == thing])
        residuals_m = frame.residuals_m[object_of_vertex == thing]
        error = f"{1e3 * np.sqrt(np.mean(residuals_m**2)):.1f}" if residuals_m.size else ""
        cells = (
            str(thing),
            color_name(thing),
            f"{pixels[thing]:,}",
            distance,
            size,
            error,
            str(surfaces[thing]),
        )
        lines.append(f"| {' | '.join(cells)} |")
    if frame.merges:
        lines += ["", "Merged surfaces:", "", *(f"- {each}" for each in frame.merges)]
    return "\n".join(lines)


def _place(points_m: NDArray[np.float32]) -> tuple[str, str]:
    """Return the distance and the size of points, if they are enough."""
    if len(points_m) < _LEAST_POINTS:
        return "", ""
    distance_m = np.linalg.norm(points_m.mean(axis=0, dtype=np.float64))
    box = OrientedBox.around(points_m[:: -(-len(points_m) // _BOX_POINTS)])
    return f"{distance_m:.2f}", " x ".join(f"{each:.2f}" for each in box.size_m)


def tree_table(frame: ViewFrame) -> str:
    """Return the tree of a frame, one line for each segment; leaves have labels.

    What was found in an earlier frame bears its number: ``0.87 @12``.
    """
    nodes, moment = frame.tree, frame.moment.frame
    leaves = sum(each.label is not None for each in nodes)
    value = f"{frame.metric.upper()} ({_METRIC_UNITS[frame.metric]})"
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
    """Return how a node is divided or why it is a leaf, with the frame of the trial that decided it."""
    by_present_values = node.stop is not None and node.stop not in TRIED
    return str(node.stop or node.division) + ("" if by_present_values else _mark(node.judged, frame))
