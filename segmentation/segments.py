"""Segments and their tree, and the nodes that they are made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import Level, Metric, SegmentationConfig
from nurbseg.segmentation.labels.images import apply_lookup_table, bounding_boxes, by_label
from nurbseg.segmentation.lazy import Lazy
from nurbseg.segmentation.points.grid import Window
from nurbseg.segmentation.surfaces.metrics import acceptance_ratio
from nurbseg.segmentation.vocabulary import SPLITS, Division, StopReason

if TYPE_CHECKING:
    from nurbseg.segmentation.cut.ncut import Cut
    from nurbseg.segmentation.objects.merge import Contact, Merge, SceneObject
    from nurbseg.segmentation.surfaces.fit import Fit


@dataclass(frozen=True, slots=True)
class Trial:
    """A split that was tried: the metric before and after it (eq. 5).

    Parameters
    ----------
    metric : str
        The deciding one.
    value, points : float, int
        Metric of the segment, no less than its floor, and the number of points that it was measured on.
    parts : tuple of (float, int)
        The same for each part: two in the paper; in the default method the connected components of both
        sides of the cut; where the live tree judges a split again, the leaves below it.
    kept : bool
        Whether the split was kept.
    """

    metric: Metric
    value: float
    points: int
    parts: tuple[tuple[float, int], ...]
    kept: bool

    @property
    def ratio(self) -> float:
        """Metric of the parts over that of the whole."""
        return acceptance_ratio(self.metric, (self.value, self.points), *self.parts)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Segment:
    """One segment of the tree.

    Parameters
    ----------
    name : str
        Path from the root: "" for the root, "010" for the paper's P010.
    parent : str or None
        Its name; None for the root.
    children : (str, str) or ()
        Names of the parts; none for a leaf.
    pixels : (N,) intp
        Flat indices into the image: leaf by leaf, in the order of leaves, and ascending within each.
    fit : Fit
        Its surface, fitted on the grid on which splits are decided.
    division : Division or None
        How it is divided into its children; None for a leaf.
    trial : Trial or None
        The split that was kept or, of a leaf, the best that was rejected; None if none was judged.
    stop : StopReason or None
        Why it is a leaf; None where it is not.
    cut : Cut or None
        The cut between its children; None for a leaf, at a gap, and where one side of the cut was too small.
    cuts_above : int
        Cuts and creases between the root and this segment, which T_d limits.
    measured : int or None
        Number of the frame in which its surface and values were measured; None for the frame itself.
    judged : int or None
        Number of the frame in which `trial`, or else `stop` or `division`, was found; None for the frame
        itself.
    """

    name: str
    parent: str | None
    children: tuple[str, str] | tuple[()]
    pixels: NDArray[np.intp]
    fit: Fit
    division: Division | None
    trial: Trial | None
    stop: StopReason | None
    cut: Cut | None = None
    cuts_above: int = 0
    measured: int | None = None
    judged: int | None = None

    def __post_init__(self) -> None:
        self.pixels.setflags(write=False)

    def __repr__(self) -> str:
        return f"Segment({self.name!r}, {self.pixels.size} pixels, {self.stop or self.division})"

    @property
    def depth(self) -> int:
        """Number of divisions of any kind between the root and this segment."""
        return len(self.name)

    @property
    def ratio(self) -> float | None:
        """Metric of the parts over that of the whole (eq. 5) where a split was tried, kept or not."""
        return None if self.trial is None else self.trial.ratio

    @property
    def is_leaf(self) -> bool:
        """Whether it is part of the final segmentation."""
        return not self.children


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SegmentationTree:
    """All segments of a frame, from the whole cloud to the final ones.

    Parameters
    ----------
    segments : sequence of Segment
        Depth first, a segment before its parts, part 0 before part 1; the root comes first.
    shape : (int, int)
        Rows and columns of the image.
    objects : tuple of SceneObject
        Largest first; each leaf is in one of them. Empty if nothing was merged.
    contacts : sequence of Contact
        Every pair of leaves that meet: whether they were merged, and why.
    merges : sequence of Merge
        How the objects were merged, in order.
    level : {"surfaces", "objects"}
        Level of `labels`.
    image : (H, W) uint16, optional
        The label of every pixel, if it is known already.
    """

    segments: Sequence[Segment]
    shape: tuple[int, int]
    objects: tuple[SceneObject, ...] = ()
    contacts: Sequence[Contact] = ()
    merges: Sequence[Merge] = ()
    level: Level = "surfaces"
    image: NDArray[np.uint16] | None = None

    def __post_init__(self) -> None:
        if self.image is not None:
            self.image.flags.writeable = False

    def __repr__(self) -> str:
        height, width = self.shape
        surfaces, objects = len(self.leaf_names), len(self.objects)
        return f"SegmentationTree({width}x{height}, {surfaces} surfaces, {objects} objects)"

    @property
    def root(self) -> Segment:
        """The whole cloud."""
        return self.segments[0]

    def leaves(self) -> tuple[Segment, ...]:
        """Return the final segments; the label of each is its index here plus one."""
        return tuple(segment for segment in self.segments if segment.is_leaf)

    @property
    def leaf_names(self) -> list[str]:
        """Names of the final segments, which are in the order of their names."""
        merged = sorted(name for each in self.objects for name in each.leaves)
        return merged or [leaf.name for leaf in self.leaves()]

    def labels(self, level: Level | None = None) -> NDArray[np.uint16]:
        """Return the label of every pixel.

        Parameters
        ----------
        level : {"surfaces", "objects"}, optional
            What a label stands for; by default the tree's own level.

        Returns
        -------
        (H, W) uint16
            0 where there is no depth. A surface's label is one plus its index among the leaves, an object's
            one plus its index in `objects`; without objects each surface is one.

        Raises
        ------
        ValueError
            If there is no such level.
        """
        if known_level(self.level if level is None else level) != "surfaces" and self.objects:
            number = {name: n for n, each in enumerate(self.objects, start=1) for name in each.leaves}
            of_label = np.array([0, *map(number.__getitem__, self.leaf_names)], dtype=np.uint16)
            return apply_lookup_table(of_label, self.labels("surfaces"))
        if self.image is not None:
            return self.image
        labels = np.zeros(self.shape[0] * self.shape[1], dtype=np.uint16)
        for label, leaf in enumerate(self.leaves(), start=1):
            labels[leaf.pixels] = label
        return labels.reshape(self.shape)

    def __getitem__(self, name: str) -> Segment:
        """Return the segment of a name."""
        for segment in self.segments:
            if segment.name == name:
                return segment
        raise KeyError(f"no segment {name!r} in this tree")


def known_level(level: Level) -> Level:
    """Return a level of labels; raises ValueError if there is none of that name."""
    if level not in (known := get_args(Level)):
        raise ValueError(f"level: expected {' or '.join(known)}, got {level!r}")
    return level


@dataclass(slots=True, eq=False)
class Node:
    """A segment while the tree grows.

    `cuts_above`, `measured` and `judged` are as those of a `Segment`. `memory` is what is remembered of it
    from frame to frame; it stays with a leaf as the tree changes.
    """

    name: str
    grid_pixels: NDArray[np.intp]
    fit: Fit
    children: tuple[Node, Node] | tuple[()] = ()
    division: Division | None = None
    trial: Trial | None = None
    stop: StopReason | None = None
    cut: Cut | None = None
    cuts_above: int = 0
    measured: int | None = None
    judged: int | None = None
    memory: object = None

    @property
    def first_name(self) -> str:
        """Its name; in a tree that is continued the first it had, so that it is cut the same way again."""
        return getattr(self.memory, "name", None) or self.name

    def value(self, config: SegmentationConfig) -> float:
        """Return the deciding metric, at least its floor; 0 if it was not measured."""
        return self.fit.value(config.metric)

    def weighed(self, config: SegmentationConfig) -> tuple[float, int]:
        """Return what counts in the ratio (eq. 5): its value, and its number of grid pixels."""
        return self.value(config), self.grid_pixels.size


#: What a segment takes over from a node.
_taken = attrgetter("name", "fit", "division", "trial", "stop", "cut", "cuts_above", "measured", "judged")


def depth_first(root: Node) -> list[Node]:
    """Return a node and all below it, a node before its parts, part 0 before part 1."""
    nodes = [root]
    for place, node in enumerate(nodes, start=1):
        if node.children:
            nodes[place:place] = node.children
    return nodes


def leaves_below(root: Node) -> list[Node]:
    """Return the leaves of a tree, in its order; the node itself if it is one."""
    return [node for node in depth_first(root) if not node.children]


def splits_in(root: Node) -> int:
    """Return how many splits a tree has, which T_s limits."""
    return sum(node.division in SPLITS for node in depth_first(root))


def leaf_ranges(nodes: list[Node]) -> dict[str, tuple[int, int]]:
    """Return the labels of the leaves below each node, by its name: the first, and one past the last.

    Nodes are depth first, and so are the labels of their leaves, from 1 on.
    """
    ranges: dict[str, tuple[int, int]] = {}
    end = 1 + sum(not node.children for node in nodes)
    for node in reversed(nodes):
        if node.children:
            first, second = (ranges[child.name] for child in node.children)
            ranges[node.name] = first[0], second[1]
        else:
            ranges[node.name] = end - 1, end
            end -= 1
    return ranges


def finished_segments(nodes: list[Node], labels: NDArray[np.uint16]) -> Sequence[Segment]:
    """Make segments of nodes as they are now: with all pixels below, inside the windows of their surfaces.

    Parameters
    ----------
    nodes : list of Node
        Depth first.
    labels : (H, W) uint16
        Index of each pixel's leaf plus one; 0 where there is no point.

    Returns
    -------
    sequence of Segment
        In the order of the nodes.
    """
    # A view stays writable, the type for which the loops are compiled anyway.
    return Lazy(partial(_segments, [_taken(node) for node in nodes], leaf_ranges(nodes), labels.view()))


def _segments(
    nodes: list[tuple[Any, ...]], ranges: dict[str, tuple[int, int]], labels: NDArray[np.uint16]
) -> Iterator[Segment]:
    count = ranges[""][1]
    order, ends = by_label(labels.reshape(-1), count)
    bounds, boxes = ends.tolist(), bounding_boxes(labels, count)
    for name, fit, division, *history in nodes:
        first, end = ranges[name]
        parent, children = (name[:-1] if name else None), ((f"{name}0", f"{name}1") if division else ())
        pixels, fit = order[bounds[first] : bounds[end]], _widened(fit, boxes[first:end])
        yield Segment(name, parent, children, pixels, fit, division, *history)


def _widened(fit: Fit, boxes: list[Window]) -> Fit:
    """Extend the window of a fit's surface to boxes of pixels: borders move after surfaces are fitted."""
    if fit.surface is None:
        return fit
    # An empty box changes nothing.
    top, left, bottom, right = zip(fit.surface.window, *boxes, strict=True)
    window = min(top), min(left), max(bottom), max(right)
    return replace(fit, surface=replace(fit.surface, window=window))
