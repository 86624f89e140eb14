"""Files of each frame's result: labels as PNG, the tree as JSON, the surfaces as NPZ; and of the settings."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.atomic_file import write_atomically
from nurbseg.app.result import FrameResult
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.segments import Segment, SegmentationTree, Trial

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


def tree_document(result: FrameResult, metric: Metric) -> dict[str, Any]:
    """Return a frame's tree as what its JSON file holds.

    Parameters
    ----------
    result : FrameResult
        The frame and its tree.
    metric : str
        Which metric decided the splits.
    """
    tree = result.tree
    numbered = tuple(zip(result.object_labels, tree.objects, strict=True))
    object_of = {name: label for label, each in numbered for name in each.leaves}
    leaf_of = {leaf.name: label for label, leaf in zip(result.surface_labels, tree.leaves(), strict=True)}
    label_of = object_of if tree.objects and tree.level == "objects" else leaf_of
    return {
        "frame": result.frame.index,
        "name": result.frame.name,
        "timestamp_ns": result.frame.timestamp_ns,
        "height": tree.shape[0],
        "width": tree.shape[1],
        "metric": metric,
        "level": tree.level,
        "segments": [
            {
                **_segment_document(each, metric, result.frame.index),
                "label": label_of.get(each.name),
                "leaf": leaf_of.get(each.name),
                "object": object_of.get(each.name),
            }
            for each in tree.segments
        ],
        "objects": [
            {"object": label, "leaves": [display_name(name) for name in each.leaves]}
            for label, each in numbered
        ],
        "events": [
            {"kind": each.kind, "label": each.identity, "other": each.other} for each in result.events
        ],
        "contacts": [
            {
                "first": display_name(each.first),
                "second": display_name(each.second),
                "merged": each.merged,
                "reason": each.reason,
            }
            for each in tree.contacts
        ],
    }


def _segment_document(each: Segment, metric: Metric, frame: int) -> dict[str, Any]:
    return {
        "name": display_name(each.name),
        "parent": None if each.parent is None else display_name(each.parent),
        "children": [display_name(child) for child in each.children],
        "size": int(each.pixels.size),
        "depth": each.depth,
        "cuts_above": each.cuts_above,
        "measured": _measured_in(each, frame),
        "judged": frame if each.judged is None else each.judged,
        "value": _number(each.fit.values.get(metric, math.nan)),
        "floor": _number(each.fit.floor),
        "values": {name: _number(value) for name, value in each.fit.values.items()},
        "ratio": None if each.ratio is None else _number(each.ratio),
        "trial": None if each.trial is None else _trial_document(each.trial),
        "division": None if each.division is None else each.division.value,
        "stop": None if each.stop is None else each.stop.value,
        "points": int(each.fit.pixels.size),
        "surface": each.fit.surface is not None,
        "reason": each.fit.reason,
    }


def _measured_in(each: Segment, frame: int) -> int | None:
    """Return the number of the frame that the values belong to; None where nothing was measured."""
    if not each.fit.values:
        return None
    return frame if each.measured is None else each.measured


def _trial_document(trial: Trial) -> dict[str, Any]:
    return {
        "metric": trial.metric,
        "value": _number(trial.value),
        "points": trial.points,
        "parts": [{"value": _number(value), "points": points} for value, points in trial.parts],
        "kept": trial.kept,
    }


def _number(value: float) -> float | None:
    # JSON knows no infinity: a ratio against nothing and a metric of nothing are both "no value".
    return float(value) if math.isfinite(value) else None


def display_name(name: str) -> str:
    """Return what the paper calls a segment: P for the whole cloud, P010 for a part."""
    return f"P{name}"


def surfaces_npz(tree: SegmentationTree) -> bytes:
    """Return the surfaces of a tree's segments as an NPZ file.

    It holds ``names`` (S,) of the segments that have a surface, ``degree`` (S, 2), ``window`` (S, 4) in
    pixels (first row, first column, one past the last of each), and of the segment ``P010`` the arrays
    ``P010_knots_u``, ``P010_knots_v`` in pixels, ``P010_control_points_m`` (n, m, 3) and
    ``P010_weights`` (n, m). Of every segment there is ``P010_measured`` (N,): flat indices of the pixels on
    which its values were measured, ascending, each as its difference to the one before.
    """
    arrays: dict[str, Any] = {}
    names, degrees, windows = [], [], []
    for each in tree.segments:
        name, surface = display_name(each.name), each.fit.surface
        arrays[f"{name}_measured"] = np.diff(each.fit.pixels, prepend=0).astype(np.int32)
        if surface is None:
            continue
        names.append(name)
        degrees.append(surface.degree)
        windows.append(surface.window)
        for part in ("knots_u", "knots_v", "control_points_m", "weights"):
            arrays[f"{name}_{part}"] = getattr(surface, part)
    arrays["names"] = np.array(names, dtype=np.str_)
    arrays["degree"] = np.array(degrees, dtype=np.int32).reshape(-1, 2)
    arrays["window"] = np.array(windows, dtype=np.int32).reshape(-1, 4)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _png(labels: NDArray[np.uint16]) -> bytes:
    written, content = cv2.imencode(".png", labels)
    if not written:
        raise ExportError(f"labels of the shape {labels.shape} cannot be written as PNG")
    return content.tobytes()
