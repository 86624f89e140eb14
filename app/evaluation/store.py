"""Keeps what a study has found, frame by frame, so that a killed run goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nurbseg.app.atomic_file import write_atomically

_FORMAT = 1


class StudyStore:
    """A folder with a study's description and one file for each finished frame.

    Files appear whole or not at all: they are written beside their place and renamed into it. Raises
    ValueError if the folder holds another study, or files that are not a study's.
    """

    def __init__(self, folder: Path, description: Mapping[str, Any]) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        for part in ("frames", "labels", "trees"):
            (folder / part).mkdir(exist_ok=True)
        wanted = {"format": _FORMAT, **description}
        path = folder / "study.json"
        if path.exists():
            found = read_json(path)
            if found != json.loads(json.dumps(wanted)):
                was, now = _flat(found), _flat(json.loads(json.dumps(wanted)))
                differing = [
                    f"{key} is {was.get(key)} there and {now.get(key)} now"
                    for key in sorted({*was, *now})
                    if was.get(key) != now.get(key)
                ]
                raise ValueError(
                    f"{path}: contains another study: {'; '.join(differing)}: "
                    "give another folder with --out, or remove this one"
                )
        else:
            write_json(path, wanted)

    def frame(self, key: str) -> dict[str, Any] | None:
        """Return what is known of a frame, or None."""
        path = self.folder / "frames" / f"{key}.json"
        return read_json(path) if path.exists() else None

    def frames(self) -> Iterator[dict[str, Any]]:
        """Yield the finished frames in the order of their keys."""
        for path in sorted((self.folder / "frames").glob("*.json")):
            yield read_json(path)

    def keep(self, key: str, frame: Mapping[str, Any], images: Mapping[str, bytes]) -> None:
        """Write a frame's results; its images and trees, by their path within the folder, first."""
        for name, content in images.items():
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content)
        write_json(self.folder / "frames" / f"{key}.json", frame)


def _flat(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return a description with what it holds of several values side by side."""
    flat: dict[str, Any] = {}
    for key, value in description.items():
        flat |= value if isinstance(value, Mapping) else {key: value}
    return flat


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; a ValueError names a file that holds none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as err:
        raise ValueError(f"{path}: not a JSON file ({err}); remove it to process its frame again") from err
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object")
    return content


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object, whole or not at all."""
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
