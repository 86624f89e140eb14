"""The growth of a tree of segments, by either method: the worst segment is split first."""

import heapq
from collections.abc import Callable, Sequence

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.segments import Node, depth_first
from nurbseg.segmentation.vocabulary import StopReason

#: Returns the time, seconds from any moment.
Clock = Callable[[], float]


def time_limit(config: SegmentationConfig, clock: Clock) -> Callable[[], bool]:
    """Return a function that says whether the time budget, which starts now, is used up."""
    if config.budget_ms == 0:
        return lambda: False
    end_s = clock() + 1e-3 * config.budget_ms
    return lambda: clock() >= end_s


def grow(
    root: Node,
    split: Callable[[Node], None],
    points_min: float,
    config: SegmentationConfig,
    time_is_over: Callable[[], bool],
    *,
    splits: int = 0,
) -> None:
    """Split segments, the one with the largest metric first (section 3.3).

    Parameters
    ----------
    root : Node
        The whole frame, fitted, with children if the frame has several components. Descendants are added to
        it, and every leaf gets its stop reason.
    split : callable
        Gives a segment children, or sets its `stop`.
    points_min : float
        T_p, in points of the grid.
    config : SegmentationConfig
        The metric, T_d and T_s.
    time_is_over : callable
        Called before each cut; once it returns True, nothing more is cut.
    splits : int
        Splits that there are already, which T_s counts too.
    """
    waiting: list[tuple[float, str, Node]] = []
    grown: Sequence[Node] = [root]
    while True:
        for node in (leaf for top in grown for leaf in depth_first(top)):
            if not node.children and node.stop is None:
                heapq.heappush(waiting, (-node.value(config), node.name, node))
        if not waiting:
            return
        node = heapq.heappop(waiting)[-1]
        node.stop = stop_without_cut(node, splits, points_min, config)
        if node.stop is None and time_is_over():
            node.stop = StopReason.BUDGET
        if node.stop is None:
            split(node)
        grown = node.children
        splits += bool(grown)


def stop_without_cut(
    node: Node, splits: int, points_min: float, config: SegmentationConfig
) -> StopReason | None:
    """Return why no cut of a segment is tried (eq. 6), None if one is.

    Parameters
    ----------
    node : Node
        The segment.
    splits : int
        Splits so far.
    points_min, config
        As for `grow`.
    """
    if node.grid_pixels.size == 0:
        return StopReason.NO_POINTS
    if node.grid_pixels.size <= 2.0 * points_min:  # eq. 6: |P| <= 2 T_p
        return StopReason.TOO_SMALL
    if node.cuts_above >= config.depth_max:  # eq. 6: T_d
        return StopReason.DEPTH
    if splits >= config.splits_max:  # eq. 6: T_s
        return StopReason.SPLITS
    if node.fit.surface is None:
        return StopReason.NO_FIT
    # A metric of 0 cannot improve (eq. 5), but the paper keeps the first split if there is any error at all.
    first = config.method == "stag15" and node.name == "" and node.fit.values["mse"] > 0
    return None if first or node.value(config) > 0 else StopReason.CRITERION
