"""Stores the results of a study by frame, so that a killed run can be resumed."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nurbseg.app.atomic_file import read_json, write_atomically, write_json
from nurbseg.app.evaluation.scoring import FrameScores
from nurbseg.app.export.exporter import differences
from nurbseg.drivers.errors import quoted
from nurbseg.drivers.files import create_folder
from nurbseg.segmentation.scoring.objects import ObjectScores

_FORMAT = 1
#: Fields of a frame that was not skipped.
_FIELDS = {"uri": str, "index": int, "name": str, "category": str, "results": dict}
#: Its scores, each a number or null, and those that are always numbers.
_SCORES, _ALWAYS = (*FrameScores._fields, *ObjectScores._fields), ("ri", "gtrc", "voi")
_NUMBER, _NUMBER_OR_NULL = int | float, int | float | None
_KINDS: dict[Any, str] = {str: "a text", int: "a whole number", dict: "an object"}
_KINDS |= {_NUMBER: "a number", _NUMBER_OR_NULL: "a number or null"}


class StudyStore:
    """A folder with a study's description and a file for each finished frame.

    Raises ValueError if the folder cannot be created, or contains another study or files of another kind.
    """

    def __init__(self, folder: Path, description: Mapping[str, Any]) -> None:
        self.folder = folder
        create_folder(folder)
        for part in ("frames", "labels", "trees"):
            (folder / part).mkdir(exist_ok=True)
        wanted = json.loads(json.dumps({"format": _FORMAT, **description}))
        path = folder / "study.json"
        if path.exists():
            found = read_json(path)
            if found != wanted:
                raise ValueError(
                    f"{path}: contains another study: {'; '.join(differences(found, wanted))}: "
                    "give another folder with --out, or remove this one"
                )
        else:
            write_json(path, wanted)

    def frame(self, key: str) -> dict[str, Any] | None:
        """Return the results of a frame, or None."""
        path = self.folder / "frames" / f"{key}.json"
        return _kept(path) if path.exists() else None

    def frames(self) -> Iterator[dict[str, Any]]:
        """Yield the finished frames in the order of their keys."""
        for path in sorted((self.folder / "frames").glob("*.json")):
            yield _kept(path)

    def keep(self, key: str, frame: Mapping[str, Any], images: Mapping[str, bytes]) -> None:
        """Write a frame's images and trees, by their path in the folder, and then its results."""
        for name, content in images.items():
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content)
        write_json(self.folder / "frames" / f"{key}.json", frame)


def _kept(path: Path) -> dict[str, Any]:
    try:
        # The key in the file may have been changed.
        frame = {**read_json(path), "key": path.stem}
        for field, value, kind in () if frame.get("skipped") else _fields(frame):
            if not isinstance(value, kind):
                raise ValueError(f"{path}: {field}: expected {_KINDS[kind]}, got {quoted(value)}")
    except ValueError as err:
        raise ValueError(f"{err}; remove it to process its frame again") from err
    return frame


def _fields(frame: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the fields of a frame with their values and types, the outer ones first."""
    for field, kind in _FIELDS.items():
        yield field, frame.get(field), kind
    yield "computer", frame.get("computer", ""), str
    for variant, scores in frame["results"].items():
        yield f"results.{variant}", scores, dict
        for score, value in {**dict.fromkeys(_SCORES, "nothing"), **scores}.items():
            yield f"results.{variant}.{score}", value, _NUMBER if score in _ALWAYS else _NUMBER_OR_NULL
