"""What a tree calls its segments, why they stopped and how they were divided; light to import."""

from __future__ import annotations

from enum import StrEnum


class StopReason(StrEnum):
    """Why a segment was not split further; the first four are the colors of the paper's figure 3.

    ``noise`` is the default method's own, and foretells ``criterion``: the metric is so near to what noise
    leaves of it that no split can have a ratio below T, and none was tried. ``untried`` is the live tree's
    own: the segment is new, or its last trial so old that it counts no more. ``budget``: the time for the
    frame was over when its turn came.
    """

    CRITERION = "criterion"
    CHILD_TOO_SMALL = "child-too-small"
    TOO_SMALL = "too-small"
    DEPTH = "depth"
    SPLITS = "splits"
    NO_CUT = "no-cut"
    NO_FIT = "no-fit"
    NO_POINTS = "no-points"
    NOISE = "noise"
    UNTRIED = "untried"
    BUDGET = "budget"


class Division(StrEnum):
    """How a segment falls into its parts.

    ``cut``: by a normalized cut that the ratio kept. ``gap``: its pixels are not connected, nothing was cut.
    ``appeared``: part 1 came into view beside or before part 0, nothing was cut.
    """

    CUT = "cut"
    GAP = "gap"
    APPEARED = "appeared"


#: Reasons that a trial, or the lack of one, came to; the others follow from the values themselves.
TRIED = (StopReason.CRITERION, StopReason.CHILD_TOO_SMALL, StopReason.NO_CUT)


def display_name(name: str) -> str:
    """Return a segment's name as the paper writes it: P, P0, P01, ..."""
    return f"P{name}"
