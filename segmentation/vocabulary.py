"""Stop reasons, divisions and names of segments, without heavy imports."""

from enum import StrEnum


class StopReason(StrEnum):
    """Why a segment was not split further; the first four are the colors of the paper's figure 3.

    ``noise`` (default method): the metric is so near its floor that no split can have a ratio below T; none
    was tried. ``untried``: the segment is a protrusion, the rest beside one, or a part at a crease.
    ``budget``: the time for the frame was used up before its turn. ``pending`` (live): as many trials as a
    frame may have were made before its turn; it is tried in one of the next frames, and its surface may be
    wrong until then. docs/files.md has the others, and which exported fields are their evidence.
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
    PENDING = "pending"


class Division(StrEnum):
    """How a segment is divided into its children.

    ``cut``: by a normalized cut that was kept. ``gap``: its pixels are not connected. ``appeared``: part 1
    came into view beside or in front of part 0. ``protrusion``: part 1 is in front of the surface.
    ``crease``: planes meet there, which one smooth surface follows within noise.
    """

    CUT = "cut"
    GAP = "gap"
    APPEARED = "appeared"
    PROTRUSION = "protrusion"
    CREASE = "crease"


#: Divisions that are splits, which T_d and T_s limit.
SPLITS = (Division.CUT, Division.CREASE)

#: Reasons that result from trying a cut; the others follow from the segment's own values.
TRIED = (StopReason.CRITERION, StopReason.CHILD_TOO_SMALL, StopReason.NO_CUT)


def display_name(name: str) -> str:
    """Return a segment's name as the paper writes it: P, P0, P01, ..."""
    return f"P{name}"
