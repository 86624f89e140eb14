"""What the tree of a frame looks like to Rerun: a tidy drawing and a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import rerun as rr

from nurbseg.app.palette import INNER_COLOR, LABEL_COLORS, STOP_COLORS, label_colors
from nurbseg.app.tree_layout import fitted, tidy_positions
from nurbseg.app.worker import FrameResult
from nurbseg.segmentation.config import Metric
from nurbseg.segmentation.tree import Segment, SegmentationTree

#: Paths and what is logged there.
Entities = Iterable[tuple[str, Any]]

TREE, TREE_TABLE = "tree", "tree_table"

#: The box in which the tree is drawn, whatever its size.
TREE_WIDTH, TREE_HEIGHT = 1000.0, 540.0
#: Distance of neighbouring nodes and of levels in a small tree, and a node's largest radius.
_SPACING, _LEVEL, _RADIUS = 70.0, 90.0, 17.0

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


def display_name(name: str) -> str:
    """Return a segment's name as the paper writes it: P, P0, P01, ..."""
    return f"P{name}"


def tree_entities(result: FrameResult, metric: Metric) -> Entities:
    """Return the drawing of a frame's tree and its table."""
    tree = result.tree
    segments = tree.segments
    labels = {leaf.name: label for label, leaf in zip(result.surface_labels, tree.leaves(), strict=True)}
    positions = tidy_positions({each.name: each.children for each in segments}, tree.root.name)
    places, spacing = fitted(
        [positions[each.name] for each in segments], TREE_WIDTH, TREE_HEIGHT - _RADIUS, _SPACING, _LEVEL
    )
    radius = min(_RADIUS, 0.42 * spacing)
    names = [display_name(each.name) for each in segments]
    edges = [(display_name(each.name), display_name(child)) for each in segments for child in each.children]
    # Below each leaf a dot in the color of its label; in the same graph, because the viewer frames each.
    at_leaf = [row for row, each in enumerate(segments) if each.is_leaf]
    numbers = [labels[segments[row].name] for row in at_leaf]
    dots = places[at_leaf] + np.array([0.0, 1.9 * radius], dtype=np.float32)
    fills = np.array([_node_color(each) for each in segments], dtype=np.uint8).reshape(-1, 3)
    dot_fills = label_colors()[(np.array(numbers, dtype=np.intp) - 1) % LABEL_COLORS]
    yield (
        TREE,
        rr.GraphNodes(
            names + [f"label {number}" for number in numbers],
            positions=np.concatenate([places, dots]),
            colors=np.concatenate([fills, dot_fills]),
            labels=names + [f"label {number}" for number in numbers],
            show_labels=False,
            radii=np.repeat(np.array([radius, 0.5 * radius], dtype=np.float32), [len(names), len(numbers)]),
        ),
    )
    yield TREE, rr.GraphEdges(edges, graph_type="directed")
    yield (
        TREE_TABLE,
        rr.TextDocument(
            _headline(result) + tree_table(tree, metric, labels), media_type=rr.MediaType.MARKDOWN
        ),
    )


def _node_color(segment: Segment) -> tuple[int, int, int]:
    return INNER_COLOR if segment.stop is None else STOP_COLORS[segment.stop]


def _headline(result: FrameResult) -> str:
    name = result.frame.name or f"frame {result.frame.index}"
    leaves = len(result.tree.leaves())
    return f"**{name}**: {leaves} final segments of {len(result.tree.segments)}\n\n"


def tree_table(tree: SegmentationTree, metric: Metric, labels: Mapping[str, int]) -> str:
    """Return the tree as a Markdown table, one line for each segment; leaves have labels, by their names."""
    lines = [
        f"| segment | label | pixels | {metric.upper()} ({_METRIC_UNITS[metric]}) | ratio | stopped by |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for each in tree.segments:
        value = each.fit.values.get(metric)
        cells = (
            display_name(each.name),
            str(labels[each.name]) if each.is_leaf else "",
            f"{each.pixels.size:,}",
            "" if value is None else f"{value:.3g}",
            "" if each.ratio is None else f"{each.ratio:.3f}",
            "" if each.stop is None else str(each.stop),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


__all__ = [
    "TREE",
    "TREE_HEIGHT",
    "TREE_TABLE",
    "TREE_WIDTH",
    "Entities",
    "display_name",
    "tree_entities",
    "tree_table",
]
