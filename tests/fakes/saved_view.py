"""Reads a saved Rerun recording back, independently of what wrote it."""

from __future__ import annotations

import warnings
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


@dataclass
class SavedView:
    """What a recording holds: for each entity and component the values by frame, and the static ones."""

    by_frame: dict[str, dict[str, dict[int, Any]]] = field(default_factory=lambda: defaultdict(dict))
    static: dict[str, dict[str, Any]] = field(default_factory=lambda: defaultdict(dict))
    texts: list[tuple[str, str]] = field(default_factory=list)

    def frames(self, path: str) -> list[int]:
        """Return the frames at which an entity was logged."""
        return sorted({frame for values in self.by_frame[path].values() for frame in values})


def read_saved_view(path: Path, *, indexed: bool = True) -> SavedView:
    """Read a recording; one whose writer did not end it has no index, and is read as far as it goes."""
    saved = SavedView()
    with warnings.catch_warnings():
        if not indexed:
            warnings.filterwarnings("ignore", message="RRD file has no footer")
        reader = RrdReader(str(path))
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        entity = str(chunk.entity_path).lstrip("/")
        is_property = entity.startswith("__properties/")
        names = [name for name in batch.schema.names if ":" in name or is_property]
        rows = {name: batch.column(name).to_pylist() for name in names}
        if chunk.is_static:
            for name in names:
                saved.static[entity][name] = rows[name][-1]
            continue
        frames = batch.column("frame").to_pylist() if "frame" in batch.schema.names else []
        if "TextLog:text" in rows:
            for text, level in zip(rows["TextLog:text"], rows["TextLog:level"], strict=True):
                saved.texts.append((level[0], text[0]))
        for name in names:
            values = saved.by_frame[entity].setdefault(name, {})
            for frame, value in zip(frames, rows[name], strict=False):
                if value is not None:
                    values[frame] = value
    return saved


__all__ = ["SavedView", "read_saved_view"]
