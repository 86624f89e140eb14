"""What is remembered of a tree from frame to frame, so that nothing is tried again without a reason."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.growth import stop_without_cut
from nurbseg.segmentation.segments import Node, Trial, depth_first, leaves_below
from nurbseg.segmentation.vocabulary import TRIED, Division, StopReason

#: A leaf is tried again if its metric over its floor has risen by so much and a share of the floor, as noise
#: alone changes what little is over the floor by more; or if its size has changed by so much.
_WORSE_SHARE, _FLOOR_SHARE, _RESIZED_SHARE = 0.2, 0.1, 0.15
#: It is looked at for protrusions again if so many times as many grid pixels are far from its surface.
_FARTHER_FACTOR = 2.0
#: Frames after which a leaf is tried again in any case.
TRIAL_FRAMES = 300
#: Frames for which it is remembered that two parts of a leaf met.
_MET_FRAMES = 60


@dataclass(frozen=True, slots=True)
class Attempt:
    """The last attempt to split a leaf: outcome, frame, and the leaf's excess over its floor and size."""

    stop: StopReason
    trial: Trial | None
    frame: int
    excess: float
    size: int


@dataclass(slots=True, eq=False)
class LeafMemory:
    """What is remembered of a leaf; one leaf has the same object in all frames.

    Parameters
    ----------
    born : int
        Number of the frame in which it was made.
    attempt : Attempt or None
        The last attempt to split it.
    far : int or None
        How many of its grid pixels are far from its surface, the fewest since it was looked at for
        protrusions; None before.
    bent : (float, int) or None
        Root mean square residual of one plane, 1/m, and size when it was looked at for creases.
    cut_from : LeafMemory or None
        The leaf that it was cut off from by something in front.
    name : str
        Its name when it was made, or cut last, by which its cuts draw their samples.
    """

    born: int
    attempt: Attempt | None = None
    far: int | None = None
    bent: tuple[float, int] | None = None
    cut_from: LeafMemory | None = None
    name: str = ""

    @property
    def origin(self) -> LeafMemory:
        """The leaf of which it is a part, itself if it was never cut off."""
        return self if self.cut_from is None else self.cut_from.origin

    def forget(self) -> None:
        """Forget what was tried: the leaf is a part of what it was."""
        self.attempt = self.far = self.bent = None


@dataclass(slots=True)
class SplitMemory:
    """What is remembered of a cut: the logarithm of its ratio over T, averaged, and when it was judged."""

    log_ratio: float
    frame: int


#: Two leaves, in any order.
LeafPair = frozenset[LeafMemory]


class TreeMemory:
    """What was tried in the frames before, and need not be tried again in this one.

    Without it every stage does what it does for a frame alone.

    Parameters
    ----------
    config : SegmentationConfig
        The metric, T_d and T_s.

    Attributes
    ----------
    frame : int
        Number of the present frame.
    trials, splits, cut_pixels : int
        Leaves that were cut in it, how many of them were split, and their grid pixels.
    """

    def __init__(self, config: SegmentationConfig) -> None:
        self.frame = self.trials = self.splits = self.cut_pixels = 0
        self._config = config
        self._met: dict[LeafPair, int] = {}

    def begin(self, root: Node, frame: int) -> None:
        """Begin a frame: leaves that are new in it get a memory."""
        self.frame, self.trials, self.splits, self.cut_pixels = frame, 0, 0, 0
        self._met = {pair: last for pair, last in self._met.items() if frame - last <= _MET_FRAMES}
        self.name_new(root)

    def name_new(self, root: Node) -> None:
        """Give a memory to leaves that have none."""
        for leaf in leaves_below(root):
            if leaf.memory is None:
                leaf.memory = LeafMemory(self.frame)
            memory = leaf_memory(leaf)
            memory.name = memory.name or leaf.name

    def recall(self, root: Node, features: GridFeatures) -> None:
        """Give leaves for which nothing has changed since their last attempt its outcome."""
        least = features.grid_pixels_min(self._config)
        for leaf in leaves_below(root):
            attempt = leaf_memory(leaf).attempt
            if leaf.stop is not None or attempt is None or self._has_changed(leaf, attempt):
                continue
            # The limit of splits is no reason if a trial was rejected.
            leaf.stop = stop_without_cut(leaf, 0, least, self._config)
            if leaf.stop is None:
                leaf.stop, leaf.trial, leaf.judged = attempt.stop, attempt.trial, attempt.frame

    def _has_changed(self, leaf: Node, attempt: Attempt) -> bool:
        size = leaf.grid_pixels.size
        return (
            self.frame - attempt.frame >= TRIAL_FRAMES
            or self._excess(leaf) > (1.0 + _WORSE_SHARE) * attempt.excess + _FLOOR_SHARE * leaf.fit.floor
            or abs(size - attempt.size) > _RESIZED_SHARE * attempt.size
        )

    def _excess(self, leaf: Node) -> float:
        return leaf.value(self._config) - leaf.fit.floor

    def remembering(self, split: Callable[[Node], None]) -> Callable[[Node], None]:
        """Return a function that splits a leaf, and remembers what came of it."""

        def split_and_remember(node: Node) -> None:
            memory = leaf_memory(node)
            split(node)
            self.trials += 1
            self.cut_pixels += node.grid_pixels.size
            if node.children:
                self.splits += 1
                node.memory = None
                # The largest part is what the leaf was.
                largest_leaf(node).memory, memory.attempt, memory.name = memory, None, ""
                self.name_new(node)
            else:
                self.note(node)

        return split_and_remember

    def note(self, leaf: Node) -> None:
        """Remember a leaf's stop reason, if that comes of an attempt."""
        if leaf.stop in TRIED:
            size = leaf.grid_pixels.size
            leaf_memory(leaf).attempt = Attempt(leaf.stop, leaf.trial, self.frame, self._excess(leaf), size)

    def meet_newly(self, one: Node, other: Node) -> bool:
        """Whether one of two leaves that meet is new, or they are parts of one leaf that meet again.

        Others are not compared: where many leaves meet now and then, as at corners, decisions near T would be
        made again and again, until each had gone one way.
        """
        first, second = leaf_memory(one), leaf_memory(other)
        is_new = self.frame in (first.born, second.born)
        if first.origin is second.origin:
            pair = frozenset((first, second))
            is_new |= pair not in self._met
            self._met[pair] = self.frame
        return is_new

    def has_more_far(self, leaf: Node, far: int, least: float) -> bool:
        """Whether a leaf is new, or clearly more of its grid pixels are far from its surface than before."""
        memory = leaf_memory(leaf)
        more = memory.far is None or far > _FARTHER_FACTOR * memory.far + least
        memory.far = far if more or memory.far is None else min(far, memory.far)
        return more

    def is_bent_anew(self, leaf: Node, rms_per_m: float) -> bool:
        """Whether a leaf is new, or one plane explains it worse or it has another size than before."""
        memory, size = leaf_memory(leaf), leaf.grid_pixels.size
        if memory.bent is not None:
            rms_before_per_m, size_before = memory.bent
            worse = rms_per_m > (1.0 + _WORSE_SHARE) * rms_before_per_m
            if not worse and abs(size - size_before) <= _RESIZED_SHARE * size_before:
                return False
        memory.bent = rms_per_m, size
        return True

    def average_ratio(self, node: Node, ratio: float, new_share: float) -> float:
        """Return the average over frames of the logarithm of a cut's ratio over T.

        The frame counts `new_share`, and more if the cut was not judged in the frames just before.
        """
        now = math.log(max(ratio, 1e-3) / self._config.ratio_max)
        if not isinstance(node.memory, SplitMemory):
            node.memory = SplitMemory(now, self.frame)
        age = self.frame - node.memory.frame
        node.memory.log_ratio += (1.0 - (1.0 - new_share) ** age) * (now - node.memory.log_ratio)
        node.memory.frame = self.frame
        return node.memory.log_ratio

    def frames_since_judged(self, cut: Node) -> int:
        """Return how many frames ago a cut was judged, or made if it was not judged since."""
        last = cut.memory.frame if isinstance(cut.memory, SplitMemory) else cut.judged
        return 0 if last is None else self.frame - last

    def oldest(self, root: Node) -> int:
        """Return how many frames ago the cut was judged that was judged least recently."""
        return max(map(self.frames_since_judged, cuts_in(root)), default=0)


def leaf_memory(leaf: Node) -> LeafMemory:
    """Return the memory of a leaf, which has one."""
    if not isinstance(leaf.memory, LeafMemory):
        raise TypeError(f"{leaf.name}: expected a leaf with a memory, got {leaf.memory}")
    return leaf.memory


def largest_leaf(node: Node) -> Node:
    """Return the largest leaf below a node."""
    return max(leaves_below(node), key=lambda leaf: leaf.grid_pixels.size)


def cuts_in(root: Node) -> list[Node]:
    """Return the nodes of a tree that are divided by a cut."""
    return [node for node in depth_first(root) if node.division is Division.CUT]
