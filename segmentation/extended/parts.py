"""Parts of a split: their fits, the ratio that judges them, and their nodes in the tree."""

from collections.abc import Iterable, Sequence

import numpy as np

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.grid import union
from nurbseg.segmentation.segments import Node, Trial
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.inverse_depth import Fitted
from nurbseg.segmentation.surfaces.metrics import acceptance_ratio
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Relative rounding of ratios.
RATIO_ROUNDING = 1e-12


def judge_split(
    whole: tuple[float, int], parts: Sequence[tuple[float, int]], config: SegmentationConfig
) -> Trial:
    """Compare the metric of a segment with that of its parts (eq. 5), each with its number of points."""
    # Floors of parts sum to that of the whole, but for rounding.
    kept = acceptance_ratio(config.metric, whole, *parts) < config.ratio_max * (1.0 - RATIO_ROUNDING)
    return Trial(config.metric, *whole, tuple(parts), kept)


def nodes_of(fitted: Iterable[Fitted], config: SegmentationConfig) -> list[Node]:
    """Make nodes without names of grid pixels and the surfaces fitted to them.

    The stop of a node is `NOISE` if its metric is so near the floor that no split can have a ratio below T.
    """
    return [
        Node("", grid_pixels, fit, stop=StopReason.NOISE if at_noise_floor(fit, config) else None)
        for grid_pixels, fit in fitted
    ]


def at_noise_floor(fit: Fit, config: SegmentationConfig) -> bool:
    """Return whether the metric is so near its floor that no split can have a ratio (eq. 5) below T."""
    # See `floor_weights`: no ratio is below floor over value.
    value = fit.value(config.metric)
    has_floor = fit.surface is not None and config.extended.noise_floor > 0
    return has_floor and fit.floor >= config.ratio_max * value


def children_of(node: Node, sides: tuple[list[Node], list[Node]]) -> tuple[Node, Node]:
    """Make two nodes of the parts of a cut's sides, or of the components of the only side.

    Parameters
    ----------
    node : Node
        That is split.
    sides : (list of Node, list of Node)
        Together at least two parts.

    Returns
    -------
    (Node, Node)
        Its children, which may have children themselves.
    """
    first, second = sides
    if not (first and second):
        parts = first or second
        largest = max(range(len(parts)), key=lambda n: parts[n].grid_pixels.size)
        first, second = [parts[largest]], parts[:largest] + parts[largest + 1 :]
    depth = node.cuts_above + 1
    return chain_components(f"{node.name}0", first, depth), chain_components(f"{node.name}1", second, depth)


def chain_components(name: str, parts: list[Node], cuts_above: int) -> Node:
    """Name and chain parts that are not connected: the largest and a node of the others, and so on."""
    parts = sorted(parts, key=lambda part: part.grid_pixels.size, reverse=True)
    node = parts.pop()
    node.name, node.cuts_above = name + "1" * len(parts), cuts_above
    for depth, part in reversed(list(enumerate(parts))):
        inner = name + "1" * depth
        part.name, part.cuts_above = f"{inner}0", cuts_above
        reason = f"{len(parts) + 1 - depth} components that are not connected"
        fit = Fit(None, np.zeros(0), {}, reason, union((part.fit.pixels, node.fit.pixels)))
        node = Node(inner, union((part.grid_pixels, node.grid_pixels)), fit, (part, node), Division.GAP)
        node.cuts_above = cuts_above
    return node
