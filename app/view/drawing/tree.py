"""What the tree of a frame looks like to Rerun: a tidy drawing and a table."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import rerun as rr

from nurbseg.app.view.drawing.frame import TreeNode, ViewFrame
from nurbseg.app.view.drawing.palette import DIVISION_COLORS, LABEL_COLORS, STOP_COLORS, label_colors
from nurbseg.app.view.drawing.tree_layout import fitted, tidy_positions
from nurbseg.segmentation.config import Metric
from nurbseg.segmentation.segments import TRIED, Division

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


def tree_entities(frame: ViewFrame, metric: Metric) -> Entities:
    """Return the drawing of a frame's tree and its table."""
    nodes = frame.tree
    positions = tidy_positions({each.name: each.children for each in nodes}, nodes[0].name)
    places, spacing = fitted(
        [positions[each.name] for each in nodes], TREE_WIDTH, TREE_HEIGHT - _RADIUS, _SPACING, _LEVEL
    )
    radius = min(_RADIUS, 0.42 * spacing)
    names = [display_name(each.name) for each in nodes]
    edges = [(display_name(each.name), display_name(child)) for each in nodes for child in each.children]
    # Below each leaf a dot in the color of its label; in the same graph, because the viewer frames each.
    at_leaf = [row for row, each in enumerate(nodes) if each.label is not None]
    numbers = [each.label for each in nodes if each.label is not None]
    dots = places[at_leaf] + np.array([0.0, 1.9 * radius], dtype=np.float32)
    fills = np.array([_node_color(each) for each in nodes], dtype=np.uint8).reshape(-1, 3)
    dot_fills = label_colors()[(np.array(numbers, dtype=np.intp) - 1) % LABEL_COLORS]
    texts = names + [f"label {number}" for number in numbers]
    yield (
        TREE,
        rr.GraphNodes(
            texts,
            positions=np.concatenate([places, dots]),
            colors=np.concatenate([fills, dot_fills]),
            labels=texts,
            show_labels=False,
            radii=np.repeat(np.array([radius, 0.5 * radius], dtype=np.float32), [len(names), len(numbers)]),
        ),
    )
    yield TREE, rr.GraphEdges(edges, graph_type="directed")
    yield (
        TREE_TABLE,
        rr.TextDocument(
            _headline(frame) + tree_table(nodes, metric, frame.moment.frame), media_type=rr.MediaType.MARKDOWN
        ),
    )


def _node_color(node: TreeNode) -> tuple[int, int, int]:
    if node.stop is not None:
        return STOP_COLORS[node.stop]
    return DIVISION_COLORS[node.division or Division.CUT]


def _headline(frame: ViewFrame) -> str:
    name = frame.name or f"frame {frame.moment.frame}"
    leaves = sum(each.label is not None for each in frame.tree)
    return f"**{name}**: {leaves} final segments of {len(frame.tree)}\n\n"


def _mark(found: int | None, frame: int) -> str:
    return "" if found in (None, frame) else f" @{found}"


def _reason(node: TreeNode, frame: int) -> str:
    """Return how a node is divided or why it is a leaf, with the frame of the trial that decided it."""
    by_present_values = node.stop is not None and node.stop not in TRIED
    return str(node.stop or node.division) + ("" if by_present_values else _mark(node.judged, frame))


def tree_table(nodes: Iterable[TreeNode], metric: Metric, frame: int) -> str:
    """Return the tree of a frame as a Markdown table, one line for each segment; leaves have labels.

    What was found in an earlier frame bears its number: ``0.87 @12``.
    """
    value = f"{metric.upper()} ({_METRIC_UNITS[metric]})"
    lines = [
        f"| segment | label | pixels | {value} | ratio | parted or stopped by |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for each in nodes:
        cells = (
            display_name(each.name),
            "" if each.label is None else str(each.label),
            f"{each.pixels:,}",
            "" if each.value is None else f"{each.value:.3g}" + _mark(each.measured, frame),
            "" if each.ratio is None else f"{each.ratio:.3f}" + _mark(each.judged, frame),
            _reason(each, frame),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
