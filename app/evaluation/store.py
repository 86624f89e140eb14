"""Stores the results of a study by frame, so that a killed run can be resumed."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nurbseg.app.atomic_file import read_json, write_atomically, write_json
from nurbseg.app.export.exporter import differences
from nurbseg.drivers.files import create_folder

_FORMAT = 1


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
        return read_json(path)
    except ValueError as err:
        raise ValueError(f"{err}; remove it to process its frame again") from err
