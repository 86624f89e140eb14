"""Reads the files of an export, strictly."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.evaluation.check.exported import (
    ExportedFrame,
    ExportedSegment,
    ExportedSurface,
    ExportedTrial,
    RunSettings,
)
from nurbseg.app.export import SETTINGS_FILE
from nurbseg.drivers.settings import in_sections, updated
from nurbseg.segmentation.config import SegmentationConfig


class DamagedExportError(ValueError):
    """A file of an export cannot be read; the message says what is wrong, `file` which one it is."""

    def __init__(self, file: str, message: str) -> None:
        super().__init__(message)
        self.file = file


def read_settings(folder: Path) -> RunSettings:
    """Read what the frames of a folder of exports were made with.

    Raises
    ------
    ValueError
        If the folder has no such file, or it is damaged.
    """
    path = folder / SETTINGS_FILE
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        segmentation, _ = in_sections(SegmentationConfig, values["segmentation"])
        return RunSettings(
            str(values["source"]),
            bool(values["temporal"]),
            float(values["target_fps"]),
            bool(values["surfaces"]),
            updated(SegmentationConfig(), **segmentation),
        )
    except FileNotFoundError:
        raise ValueError(f"{path}: does not exist; nurbseg-live --export writes it") from None
    except OSError as err:
        raise ValueError(f"{path}: cannot be read: {err.strerror}") from err
    except KeyError as err:
        raise ValueError(f"{path}: {err.args[0]} is missing; export again with this version") from err
    except (AttributeError, TypeError, ValueError) as err:
        raise ValueError(f"{path}: {err}; export again with this version") from err


def read_frame(folder: Path, stem: str, *, surfaces: bool) -> ExportedFrame:
    """Read the files of one frame.

    Parameters
    ----------
    folder : Path
        Of the export.
    stem : str
        The frame's number, as in the names of its files.
    surfaces : bool
        Whether there is a file of surfaces.

    Raises
    ------
    DamagedExportError
        If a file is missing or not what it should be.
    """
    file = f"{stem}_tree.json"
    try:
        document = json.loads((folder / file).read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise ValueError("expected an object")
        number, timestamp_ns = (_typed(document, key, int) for key in ("frame", "timestamp_ns"))
        segments = [_segment(each, number) for each in _typed(document, "segments", list)]
        objects = {
            _typed(each, "object", int): tuple(_typed(each, "leaves", list))
            for each in _typed(document, "objects", list)
        }
        contacts = tuple(
            (_typed(each, "first", str), _typed(each, "second", str), _typed(each, "merged", bool))
            for each in _typed(document, "contacts", list)
        )
        shape = _typed(document, "height", int), _typed(document, "width", int)
        about = [_typed(document, key, str) for key in ("name", "metric", "level")]
        if len({each.name for each in segments}) < len(segments) or not segments:
            raise ValueError("segments: expected at least one, and each name once")
    except OSError as err:
        raise DamagedExportError(file, f"cannot be read: {err.strerror}") from err
    except (ValueError, TypeError, AttributeError) as err:
        raise DamagedExportError(file, str(err)) from err
    kinds = ("labels", "surfaces", "objects") if objects else ("labels",)
    by_name, measured = _surfaces(folder, f"{stem}_surfaces.npz") if surfaces else ({}, {})
    return ExportedFrame(
        stem=stem,
        frame=number,
        name=about[0],
        timestamp_ns=timestamp_ns,
        shape=shape,
        metric=about[1],
        level=about[2],
        segments={each.name: each for each in segments},
        objects=objects,
        contacts=contacts,
        images={kind: _image(folder, f"{stem}_{kind}.png", shape) for kind in kinds},
        surfaces=by_name,
        measured=measured,
    )


def _typed(document: Any, key: str, *kinds: type) -> Any:
    """Return the value of a key that must be of one of some kinds."""
    if not isinstance(document, dict) or key not in document:
        raise ValueError(f"{key} is missing")
    value = document[key]
    # To Python, a truth value is a whole number.
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        names = " or ".join("null" if kind is type(None) else kind.__name__ for kind in kinds)
        raise ValueError(f"{key}: expected {names}, got {value!r}")
    return value


_NUMBER = (float, int, type(None))


def _segment(document: Any, frame: int) -> ExportedSegment:
    name = _typed(document, "name", str)
    # Told where they are another frame's.
    for key in ("measured", "judged"):
        if document.get(key) is None:
            document[key] = frame
    try:
        tried = _typed(document, "trial", dict, type(None))
        return ExportedSegment(
            name=name,
            parent=_typed(document, "parent", str, type(None)),
            children=tuple(_typed(document, "children", list)),
            size=_typed(document, "size", int),
            depth=_typed(document, "depth", int),
            value=_typed(document, "value", *_NUMBER),
            values={
                key: _typed(document["values"], key, *_NUMBER) for key in _typed(document, "values", dict)
            },
            ratio=_typed(document, "ratio", *_NUMBER),
            trial=None if tried is None else _trial(tried),
            division=_typed(document, "division", str, type(None)),
            stop=_typed(document, "stop", str, type(None)),
            points=_typed(document, "points", int),
            surface=_typed(document, "surface", bool),
            reason=_typed(document, "reason", str),
            label=_typed(document, "label", int, type(None)),
            leaf=_typed(document, "leaf", int, type(None)),
            object=_typed(document, "object", int, type(None)),
            floor=_typed(document, "floor", float, int),
            measured=_typed(document, "measured", int),
            judged=_typed(document, "judged", int),
        )
    except ValueError as err:
        raise ValueError(f"{name} {err}") from err


def _trial(document: Any) -> ExportedTrial:
    whole, *parts = (
        (_typed(each, "value", *_NUMBER), _typed(each, "points", int))
        for each in (document, *_typed(document, "parts", list))
    )
    kept = _typed(document, "kept", bool)
    return ExportedTrial(_typed(document, "metric", str), whole, tuple(parts), kept)


def _image(folder: Path, file: str, shape: tuple[int, int]) -> NDArray[np.uint16]:
    try:
        content = np.frombuffer((folder / file).read_bytes(), dtype=np.uint8)
    except OSError as err:
        raise DamagedExportError(file, f"cannot be read: {err.strerror}") from err
    image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if image is None or image.dtype != np.uint16 or image.shape != shape:
        got = "no image" if image is None else f"{image.shape} {image.dtype}"
        raise DamagedExportError(file, f"expected an image {shape} uint16, got {got}")
    return np.asarray(image, dtype=np.uint16)


def _surfaces(folder: Path, file: str) -> tuple[dict[str, ExportedSurface], dict[str, NDArray[np.int64]]]:
    try:
        with (folder / file).open("rb") as opened, np.load(opened) as arrays:
            surfaces = {
                name: ExportedSurface(
                    degree=tuple(degree),
                    window=tuple(window),
                    **{
                        part: arrays[f"{name}_{part}"]
                        for part in ("knots_u", "knots_v", "control_points_m", "weights")
                    },
                )
                for name, degree, window in zip(
                    *(arrays[key].tolist() for key in ("names", "degree", "window")), strict=True
                )
            }
            measured = {
                key.removesuffix("_measured"): np.cumsum(arrays[key], dtype=np.int64)
                for key in arrays.files
                if key.endswith("_measured")
            }
    except OSError as err:
        raise DamagedExportError(file, f"cannot be read: {err.strerror or err}") from err
    except (KeyError, ValueError, EOFError, zipfile.BadZipFile) as err:
        raise DamagedExportError(file, str(err)) from err
    return surfaces, measured
