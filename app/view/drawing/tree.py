"""The tree of a frame as Rerun's graphs: of all segments, and folded by object."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr

from nurbseg.app.view.drawing.frame import TreeNode, ViewFrame
from nurbseg.library import palette
from nurbseg.library.tree_layout import fitted, tree_positions
from nurbseg.segmentation.vocabulary import Division, display_name

#: Paths and what is logged there.
Entities = Iterable[tuple[str, Any]]

TREE, OBJECT_TREE = "tree", "tree_by_object"

#: Size of the drawing, for trees of any size.
TREE_WIDTH, TREE_HEIGHT = 1000.0, 540.0
#: Distance of neighboring nodes and of levels in a small tree, and a node's largest radius.
_SPACING, _LEVEL, _RADIUS = 70.0, 90.0, 17.0
#: Radius of the smallest nodes, as a share of the largest.
_LEAST_RADIUS = 0.45


def tree_entities(frame: ViewFrame) -> Entities:
    """Return the graph of a frame's tree and, if there are objects, of the tree folded by object."""
    if frame.objects is not None:
        folded = folded_by_object(frame.tree)
        names = {segment.name: _object_name(segment) for segment in folded}
        fills = [
            palette.label_color(segment.thing) if segment.thing else _node_color(segment)
            for segment in folded
        ]
        yield from _drawing(OBJECT_TREE, folded, names, fills, {})
    names = {segment.name: display_name(segment.name) for segment in frame.tree}
    shades = palette.shades_of_surfaces(frame.object_of_surface)
    dots = {
        segment.name: (f"label {segment.label}", palette.shaded(*shades[segment.label]))
        for segment in frame.tree
        if segment.label
    }
    yield from _drawing(TREE, frame.tree, names, [_node_color(segment) for segment in frame.tree], dots)


def folded_by_object(nodes: Sequence[TreeNode]) -> list[TreeNode]:
    """Return a tree, depth first, in which each subtree within one object becomes a leaf."""
    by_name = {node.name: node for node in nodes}
    things: dict[str, set[int | None]] = {}
    for node in reversed(nodes):
        things[node.name] = {node.thing}.union(*(things[child] for child in node.children))
        if node.children:
            things[node.name].discard(None)
    folded: list[TreeNode] = []
    waiting = [nodes[0].name]
    while waiting:
        node = by_name[waiting.pop()]
        if len(things[node.name]) > 1:
            waiting += reversed(node.children)
        elif node.children:
            (thing,) = things[node.name]
            node = replace(node, children=(), thing=thing)
        folded.append(node)
    return folded


def _drawing(
    path: str,
    nodes: Sequence[TreeNode],
    names: Mapping[str, str],
    fills: Sequence[tuple[int, int, int]],
    dots: Mapping[str, tuple[str, tuple[int, int, int]]],
) -> Entities:
    """Return a tree as a graph, with dots below nodes, each with its own name and color.

    Dots are in the same graph, because the viewer scales each graph separately.
    """
    positions = tree_positions({node.name: node.children for node in nodes}, nodes[0].name)
    places, spacing = fitted(
        [positions[node.name] for node in nodes], TREE_WIDTH, TREE_HEIGHT - _RADIUS, _SPACING, _LEVEL
    )
    radius = min(_RADIUS, 0.45 * spacing)
    shares = np.array([node.pixels for node in nodes]) / max(nodes[0].pixels, 1)
    radii = radius * np.clip(shares**0.25, _LEAST_RADIUS, 1.0)
    rows = [row for row, node in enumerate(nodes) if node.name in dots]
    below = places[rows] + np.stack([np.zeros(len(rows)), radii[rows] + 0.7 * radius], axis=-1)
    texts = [*names.values(), *(text for text, _ in dots.values())]
    yield (
        path,
        rr.GraphNodes(
            texts,
            positions=np.concatenate([places, below.astype(np.float32)]),
            colors=np.array([*fills, *(color for _, color in dots.values())], dtype=np.uint8),
            labels=texts,
            show_labels=False,
            radii=np.concatenate([radii, np.full(len(rows), 0.5 * radius)]),
        ),
    )
    edges = [(names[node.name], names[child]) for node in nodes for child in node.children]
    # Rerun converts an array much faster than a list.
    yield path, rr.GraphEdges(np.array(edges, dtype=np.str_).reshape(-1, 2), graph_type="directed")


def _object_name(node: TreeNode) -> str:
    name = display_name(node.name)
    return f"object {node.thing}: {name}" if node.thing else name


def _node_color(node: TreeNode) -> tuple[int, int, int]:
    if node.stop is not None:
        return palette.STOP_COLORS[node.stop]
    return palette.DIVISION_COLORS[node.division or Division.CUT]
