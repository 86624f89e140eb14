"""Whether the files of a run that was ended by a signal are whole."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2


def contradictory_trees(folder: Path) -> list[str]:
    """Return the names of the trees of an export that have another number of pixels than their labels."""
    wrong = []
    for tree in folder.glob("*_tree.json"):
        labels = cv2.imread(str(tree).replace("_tree.json", "_labels.png"), cv2.IMREAD_UNCHANGED)
        if labels is None or json.loads(tree.read_text())["segments"][0]["size"] != (labels > 0).sum():
            wrong.append(tree.name)
    return wrong


def viewer_chunks(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the entity and the records of each chunk of a viewer's file, except static ones."""
    from rerun.chunk import RrdReader  # late, so that the command decides how much Rerun says

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="RRD file has no footer")
        for chunk in RrdReader(str(path)).stream():
            records = chunk.to_record_batch()
            if not chunk.is_static:
                yield str(chunk.entity_path).strip("/"), records
