"""Splits as they are judged, for those who watch a tree grow."""

from collections.abc import Callable
from dataclasses import dataclass

from nurbseg.segmentation.segments import Trial
from nurbseg.segmentation.surfaces.fit import Fit


@dataclass(frozen=True, slots=True, eq=False)
class JudgedSplit:
    """A split as it is judged, kept or not: what a tree does not keep of the splits that were rejected.

    Parameters
    ----------
    trial : Trial
        The same object as that of the segment, if no other trial replaces it.
    fits : tuple of Fit
        Of each part, in the order of the trial's.
    sides : tuple of int
        The side of the cut that each part is on, 0 or 1.
    folded : bool
        Whether two leaves that meet smoothly were compared with one surface for both.
    """

    trial: Trial
    fits: tuple[Fit, ...]
    sides: tuple[int, ...]
    folded: bool = False


#: Called with every split of a frame that is judged.
Observer = Callable[[JudgedSplit], None]


def unobserved(split: JudgedSplit) -> None:
    """Do nothing with a split."""
