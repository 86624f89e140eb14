"""Reads the files of an export, strictly."""

import json
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.evaluation.check.exported import (
    ExportedFrame,
    ExportedSegment,
    ExportedSurface,
    ExportedTree,
)
from nurbseg.app.export.exporter import SETTINGS_FILE, RunSettings
from nurbseg.drivers.calibration.file import cameras_of_table
from nurbseg.drivers.errors import CalibrationError
from nurbseg.drivers.settings import in_sections, updated
from nurbseg.segmentation.config import DepthConfig, SegmentationConfig


class DamagedExportError(ValueError):
    """A file of an export cannot be read; the message says what is wrong, `file` which one it is."""

    def __init__(self, file: str, message: str) -> None:
        super().__init__(message)
        self.file = file


def read_settings(folder: Path) -> RunSettings:
    """Read the settings of a folder of exports; raises ValueError if they are missing or damaged."""
    path = folder / SETTINGS_FILE
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        camera, depth_scale = values.get("camera"), values.get("depth_scale")
        segmentation, _ = in_sections(SegmentationConfig, values["segmentation"])
        return RunSettings(
            updated(SegmentationConfig(), **segmentation),
            str(values["source"]),
            bool(values["temporal"]),
            float(values["target_fps"]),
            bool(values["surfaces"]),
            # Exports of an earlier version have none.
            updated(DepthConfig(), **in_sections(DepthConfig, values.get("depth", {}))[0]),
            None if camera is None else cameras_of_table(path, camera).calibration(),
            None if depth_scale is None else float(depth_scale),
        )
    except FileNotFoundError:
        raise ValueError(f"{path}: does not exist; nurbseg-live --export writes it") from None
    except OSError as err:
        raise ValueError(f"{path}: cannot be read: {err.strerror}") from err
    except KeyError as err:
        raise ValueError(f"{path}: {err.args[0]} is missing; export again with this version") from err
    except CalibrationError as err:
        raise ValueError(f"{err}; export again with this version") from err
    except (AttributeError, TypeError, ValueError) as err:
        raise ValueError(f"{path}: {err}; export again with this version") from err


def read_frame(folder: Path, stem: str, settings: RunSettings) -> ExportedFrame:
    """Read the files of a frame, whose names begin with `stem`.

    Raises DamagedExportError if a file is missing or not as expected.
    """
    file = f"{stem}_tree.json"
    try:
        tree: ExportedTree = _decoded(ExportedTree, _filled_in(json.loads((folder / file).read_bytes())))
        if len({each.name for each in tree.segments}) < len(tree.segments) or not tree.segments:
            raise ValueError("segments: expected at least one, and each name once")
    except OSError as err:
        raise DamagedExportError(file, f"cannot be read: {err.strerror}") from err
    except (ValueError, TypeError, AttributeError) as err:
        raise DamagedExportError(file, str(err)) from err
    kinds = ("labels", "surfaces", "objects") if tree.objects else ("labels",)
    images = {kind: _image(folder, f"{stem}_{kind}.png", (tree.height, tree.width)) for kind in kinds}
    surfaces, measured = _surfaces(folder, f"{stem}_surfaces.npz") if settings.surfaces else ({}, {})
    return ExportedFrame(stem, settings, tree, images, surfaces, measured)


def _filled_in(document: Any) -> Any:
    """Fill in fields that earlier versions left out."""
    for each in document.get("segments", ()):
        for key in ("measured", "judged"):
            if each.get(key) is None:
                each[key] = document.get("frame")
    document.setdefault("joins", [])
    for each in document.get("contacts", ()):
        for key in ("samples", "log_odds", "evidence"):
            each.setdefault(key, None)
    return document


_type_hints = cache(get_type_hints)


def _decoded(kind: Any, value: Any) -> Any:
    """Convert a JSON value to a type: objects to dataclasses, lists to tuples.

    Raises ValueError, which names the field and its segment, or TypeError if the value itself does not fit.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return None if value is None else _decoded(inner[0], value)
    if origin is tuple and isinstance(value, list):
        return tuple(_decoded(inner[0], each) for each in value)
    if origin is Mapping and isinstance(value, dict):
        return {key: _decoded(inner[1], each) for key, each in value.items()}
    if origin is None and hasattr(kind, "__annotations__") and isinstance(value, dict):
        fields = {}
        whose = f"{value.get('name')} " if kind is ExportedSegment else ""
        for name, hint in _type_hints(kind).items():
            if name not in value:
                raise ValueError(f"{whose}{name} is missing")
            try:
                fields[name] = _decoded(hint, value[name])
            except TypeError as err:
                raise ValueError(f"{whose}{name}: {err}") from err
            except ValueError as err:
                raise ValueError(f"{whose}{err}") from err
        return kind(**fields)
    kinds = (float, int) if kind is float else origin or kind
    # In Python, bool is a subclass of int.
    if isinstance(value, bool) == (kind is bool) and isinstance(value, kinds):
        return value
    raise TypeError(f"expected {getattr(kind, '__name__', kind)}, got {value!r}")


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
