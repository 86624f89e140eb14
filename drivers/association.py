"""Pairs the images of two lists by their times."""

from __future__ import annotations

import bisect

#: Partners looked at for an image: more are within the limit only where a list is not one of a camera.
_NEAR_MAX = 64


def associate(first: list[int], second: list[int], limit: int) -> list[tuple[int, int]]:
    """Pair two sorted lists of times, nearest first, each time being used once.

    Parameters
    ----------
    first, second : list of int
        Ascending times, both in one unit.
    limit : int
        Largest difference of a pair.

    Returns
    -------
    list of (int, int)
        Indices into the two lists, ascending.
    """
    near = []
    for place, moment in enumerate(first):
        begin, end = bisect.bisect_left(second, moment - limit), bisect.bisect_right(second, moment + limit)
        if end - begin > _NEAR_MAX:
            middle = bisect.bisect_left(second, moment)
            begin, end = max(begin, middle - _NEAR_MAX // 2), min(end, middle + _NEAR_MAX // 2)
        near += [(abs(second[other] - moment), place, other) for other in range(begin, end)]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, place, other in sorted(near):
        if place not in pairs and other not in taken:
            pairs[place] = other
            taken.add(other)
    return sorted(pairs.items())
