"""The category of a frame in its data set."""

from __future__ import annotations

import re
from pathlib import PurePath

#: Last number of each category of the (modified) Object Segmentation Database, as its README lists them.
_OSD = {
    "learn": ((16, "boxes"), (24, "stacked boxes"), (32, "occluded objects"), (44, "cylindric objects")),
    "test": (
        (15, "boxes"),
        (23, "stacked boxes"),
        (30, "occluded objects"),
        (42, "cylindric objects"),
        (54, "mixed objects"),
        (65, "complex scene"),
    ),
}


def category_of(name: str, uri: str) -> str:
    """Return a frame's category.

    Frames of the Object Segmentation Database (``learn12``, ``test3``) have those of the data set; frames
    named ``scene2...`` have one for each scene, as in the paper's tables; others have one for each source.
    """
    match = re.fullmatch(r"(learn|test)(\d+)", name)
    if match:
        for last, category in _OSD[match[1]]:
            if int(match[2]) <= last:
                return category
    match = re.match(r"scene[_ ]?(\d+)", name)
    if match:
        return f"scene {int(match[1])}"
    return PurePath(uri.partition("?")[0]).stem or uri
