"""Files of each frame's result: labels as PNG, the tree as JSON, the surfaces as NPZ; and of the settings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.atomic_file import write_atomically
from nurbseg.app.export.surfaces import surfaces_npz
from nurbseg.app.export.tree import tree_document
from nurbseg.app.result import FrameResult
from nurbseg.segmentation.config import Metric, SegmentationConfig

#: The file of an export that holds what all its frames were made with.
SETTINGS_FILE = "settings.json"


class ExportError(Exception):
    """A result cannot be written; the message says where, why, and what is kept."""


def run_settings(
    config: SegmentationConfig,
    *,
    source: str = "",
    temporal: bool = False,
    target_fps: float = 0.0,
    surfaces: bool = False,
) -> dict[str, Any]:
    """Return what ``settings.json`` holds: all that the frames of one export have in common.

    Parameters
    ----------
    config : SegmentationConfig
        How frames are segmented.
    source : str
        Where they come from.
    temporal : bool
        Whether a frame continues the one before it.
    target_fps : float
        Rate that is held by a coarser grid, 1/s; 0 where the grid is always that of `config`.
    surfaces : bool
        Whether the fitted surfaces are written.
    """
    return {
        "source": source,
        "temporal": temporal,
        "target_fps": target_fps,
        "surfaces": surfaces,
        "segmentation": asdict(config),
    }


class Exporter:
    """Writes results to a folder, each file whole or not at all.

    A frame's files are named by its number: ``000012_labels.png``, ``000012_tree.json`` and, if asked
    for, ``000012_surfaces.npz``. Where surfaces were merged into objects, ``000012_surfaces.png`` and
    ``000012_objects.png`` hold both; the labels are those that the level asks for. Where frames continue
    each other, a segment has one label in all of them. The tree is written last: where it is, the others
    are.

    Beside them ``settings.json`` holds what all frames were made with. A folder that holds results of other
    settings is refused.

    Parameters
    ----------
    directory : Path
        Made where it does not exist; files of the same names are replaced.
    settings : mapping
        Of `run_settings`.

    Attributes
    ----------
    written : int
        Frames written so far.
    metric, surfaces : str, bool
        Of the settings: arguments of `frame_files`.

    Raises
    ------
    ExportError
        If the folder cannot be made, or holds other results.
    """

    def __init__(self, directory: Path, settings: Mapping[str, Any]) -> None:
        self.directory = directory
        self.written = 0
        self.metric: Metric = settings["segmentation"]["metric"]
        self.surfaces: bool = settings["surfaces"]
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as err:
            raise ExportError(f"{directory}: cannot be made: {err.strerror}") from err
        _refuse_other_results(directory, settings)
        try:
            write_atomically(directory / SETTINGS_FILE, (json.dumps(settings, indent=1) + "\n").encode())
        except OSError as err:
            raise ExportError(f"{directory / SETTINGS_FILE}: cannot be written: {err.strerror}") from err

    def write(self, result: FrameResult) -> None:
        """Write the files of one frame.

        Raises
        ------
        ExportError
            If one cannot be written.
        """
        self.write_files(frame_files(result, self.metric, surfaces=self.surfaces))

    def write_files(self, files: Mapping[str, bytes]) -> None:
        """Write the files of one frame that `frame_files` has made, in their order.

        Raises
        ------
        ExportError
            If one cannot be written.
        """
        for name, content in files.items():
            try:
                write_atomically(self.directory / name, content)
            except OSError as err:
                raise ExportError(
                    f"{self.directory / name}: cannot be written: {err.strerror}; "
                    f"the {self.written} frames before are kept in {self.directory}"
                ) from err
        self.written += 1


def frame_files(result: FrameResult, metric: Metric, *, surfaces: bool) -> dict[str, bytes]:
    """Return the files of a frame by name, the tree last.

    Parameters
    ----------
    result : FrameResult
        The frame and its tree.
    metric : str
        Which metric decided the splits.
    surfaces : bool
        Whether the fitted surfaces are wanted.

    Raises
    ------
    ExportError
        If the labels cannot be a PNG.
    """
    stem = f"{result.frame.index:06d}"
    tree = result.tree
    files = {f"{stem}_labels.png": _png(result.labels())}
    if tree.objects:
        files[f"{stem}_surfaces.png"] = _png(result.labels("surfaces"))
        files[f"{stem}_objects.png"] = _png(result.labels("objects"))
    if surfaces:
        files[f"{stem}_surfaces.npz"] = surfaces_npz(tree)
    document = tree_document(result, metric)
    files[f"{stem}_tree.json"] = (json.dumps(document, indent=1) + "\n").encode()
    return files


def _refuse_other_results(directory: Path, settings: Mapping[str, Any]) -> None:
    """Raise if a folder holds results that were made with other settings."""
    advice = "export to another folder, or delete this one"
    path = directory / SETTINGS_FILE
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if any(directory.glob("*_tree.json")):
            raise ExportError(f"{directory}: holds results without {SETTINGS_FILE}; {advice}") from None
        return
    except (OSError, ValueError) as err:
        raise ExportError(f"{path}: cannot be read: {err}; {advice}") from err
    if before != settings:
        was, now = _flat(before), _flat(settings)
        differing = (
            f"{key} is {was.get(key)} there and {now.get(key)} now"
            for key in {**was, **now}
            if was.get(key) != now.get(key)
        )
        raise ExportError(f"{path}: is of another run: {', '.join(differing)}; {advice}")


def _flat(settings: Any) -> dict[str, Any]:
    """Return settings and those of the segmentation side by side."""
    if not isinstance(settings, Mapping):
        return {}
    return {**settings, **settings.get("segmentation", {}), "segmentation": None}


def _png(labels: NDArray[np.uint16]) -> bytes:
    written, content = cv2.imencode(".png", labels)
    if not written:
        raise ExportError(f"labels of the shape {labels.shape} cannot be written as PNG")
    return content.tobytes()
