"""Reads a saved Rerun recording back, independently of what wrote it."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
from rerun.chunk import RrdReader


class ValuesByFrame(Mapping[int, Any]):
    """The values of a component, as Python's lists and numbers once asked for: images have very many."""

    def __init__(self) -> None:
        self._values: dict[int, pa.Scalar[Any]] = {}

    def add(self, frames: list[int], column: pa.Array[Any]) -> None:
        """Add those values of a column that there are."""
        self._values |= {frame: value for frame, value in zip(frames, column, strict=True) if value.is_valid}

    def __getitem__(self, frame: int) -> Any:
        return self._values[frame].as_py()

    def __iter__(self) -> Iterator[int]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


@dataclass
class SavedView:
    """What a recording holds: for each entity and component the values by frame, and the static ones."""

    by_frame: dict[str, dict[str, ValuesByFrame]] = field(default_factory=lambda: defaultdict(dict))
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
        if chunk.is_static:
            for name in names:
                saved.static[entity][name] = batch.column(name)[-1].as_py()
            continue
        if "TextLog:text" in names:
            columns = (batch.column(name).to_pylist() for name in ("TextLog:level", "TextLog:text"))
            saved.texts += [(level[0], text[0]) for level, text in zip(*columns, strict=True)]
        if "frame" in batch.schema.names:
            frames = batch.column("frame").to_pylist()
            for name in names:
                saved.by_frame[entity].setdefault(name, ValuesByFrame()).add(frames, batch.column(name))
    return saved


__all__ = ["SavedView", "read_saved_view"]
