"""Reads the files of an export, strictly."""

from collections.abc import Mapping
from functools import cache
from inspect import Parameter, signature
from io import BytesIO
from pathlib import Path
from types import UnionType
from typing import Any, NamedTuple, get_args, get_origin

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.export.run_settings import SETTINGS_FILE, RunSettings
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.common.errors import RecordingFormatError, quoted
from nurbseg.common.files import read_file, read_json
from nurbseg.common.limits import FRAME_BYTES_MAX
from nurbseg.common.settings import updated
from nurbseg.drivers.calibration.file import cameras_of_table
from nurbseg.drivers.datasets.images import decode
from nurbseg.evaluation.check.exported import (
    ExportedFrame,
    ExportedObjects,
    ExportedSegment,
    ExportedSurface,
    ExportedTree,
)

#: Bytes of a frame's file of surfaces: 64 MiB, a hundred times what one takes.
_NPZ_BYTES_MAX = 1 << 26
#: Numbers in JSON are below it, so that products of some of them are numbers.
_NUMBER_LIMIT = 1e100
#: Kind of the numbers or texts of each array, its dimensions, and the length of its last axis, 0 for any.
_ARRAYS = {
    "names": ("U", 1, 0),
    "degree": ("i", 2, 2),
    "window": ("i", 2, 4),
    "knots_u": ("f", 1, 0),
    "knots_v": ("f", 1, 0),
    "control_points_m": ("f", 3, 3),
    "weights": ("f", 2, 0),
    "measured": ("i", 1, 0),
}
_OF_A_SURFACE = ("knots_u", "knots_v", "control_points_m", "weights")


class DamagedExportError(ValueError):
    """A file of an export cannot be read; the message says what is wrong, `file` which one it is."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(message.removeprefix(f"{path}: ").removeprefix("the file "))
        self.file = path.name


class _Settings(NamedTuple):
    """The fields of `RunSettings` in the file."""

    segmentation: dict[str, Any]
    source: str
    temporal: bool
    target_fps: float
    surfaces: bool
    depth: dict[str, Any]
    camera: dict[str, Any] | None
    depth_scale: float | None
    computer: str
    trials_max: int


def read_settings(folder: Path) -> RunSettings:
    """Read the settings of a folder of exports; raises ValueError if they are missing or damaged."""
    path = folder / SETTINGS_FILE
    try:
        values: Any = _decoded(_Settings, read_json(path))
        config = updated(AppConfig(), segmentation=values.segmentation, depth=values.depth)
        read: dict[str, Any] = {"segmentation": config.segmentation, "depth": config.depth}
        if values.camera is not None:
            read["camera"] = cameras_of_table(path, values.camera).calibration()
        return RunSettings(*values._replace(**read))
    except FileNotFoundError as err:
        raise ValueError(f"{err}; nurbseg-live --export writes it") from None
    except ValueError as err:
        reason = str(err).removeprefix(f"{path}: ")
        raise ValueError(f"{path}: {reason}; export again with this version") from err


def read_frame(folder: Path, stem: str, settings: RunSettings) -> ExportedFrame:
    """Read the files of a frame, whose names begin with `stem`.

    Raises DamagedExportError if a file is missing or not as expected.
    """
    path = folder / f"{stem}_tree.json"
    try:
        document: Any = read_json(path)
        for each in document.get("segments", ()):
            # Null where nothing was measured or tried.
            each |= {key: document.get("frame") for key in ("measured", "judged") if each.get(key, 0) is None}
        tree: ExportedTree = _decoded(ExportedTree, document)
        if len({segment.name for segment in tree.segments}) < len(tree.segments) or not tree.segments:
            raise ValueError("segments: expected at least one, and each name once")
    except (OSError, ValueError, TypeError, AttributeError) as err:
        raise DamagedExportError(path, str(err)) from err
    kinds = ("labels", "surfaces", "objects") if tree.objects else ("labels",)
    images = {kind: _image(folder / f"{stem}_{kind}.png", (tree.height, tree.width)) for kind in kinds}
    surfaces, measured = _surfaces(folder / f"{stem}_surfaces.npz") if settings.surfaces else ({}, {})
    objects = _objects(folder / f"{stem}_objects.json")
    return ExportedFrame(stem, settings, tree, images, surfaces, measured, objects)


def _objects(path: Path) -> ExportedObjects | None:
    """Read the file of the measured objects; None if there is none."""
    if not path.exists():
        return None
    try:
        found: ExportedObjects = _decoded(ExportedObjects, read_json(path))
        return found
    except (OSError, ValueError, TypeError) as err:
        raise DamagedExportError(path, str(err)) from err


_parameters = cache(lambda kind: signature(kind).parameters)


def _decoded(kind: Any, value: Any) -> Any:
    """Convert a JSON value to a type: objects to dataclasses with their defaults, lists to tuples.

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
        for name, parameter in _parameters(kind).items():
            if name not in value:
                if parameter.default is Parameter.empty:
                    raise ValueError(f"{whose}{name} is missing")
                continue
            try:
                fields[name] = _decoded(parameter.annotation, value[name])
            except TypeError as err:
                raise ValueError(f"{whose}{name}: {err}") from err
            except ValueError as err:
                raise ValueError(f"{whose}{err}") from err
        return kind(**fields)
    kinds = (float, int) if kind is float else origin or kind
    # In Python, bool is a subclass of int.
    fits = isinstance(value, bool) == (kind is bool) and isinstance(value, kinds)
    # NaN is not below it, either.
    if fits and (kind not in (int, float) or abs(value) < _NUMBER_LIMIT):
        return value
    raise TypeError(f"expected {getattr(kind, '__name__', kind)}, got {quoted(value)}")


def _image(path: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    try:
        image = decode(read_file(path, FRAME_BYTES_MAX, what="file"), cv2.IMREAD_UNCHANGED, f"{path}")
    except RecordingFormatError as err:
        raise DamagedExportError(path, str(err)) from err
    if image.dtype != np.uint16 or image.shape != shape:
        raise DamagedExportError(path, f"expected an image {shape} uint16, got {image.shape} {image.dtype}")
    return np.asarray(image, dtype=np.uint16)


def _surfaces(path: Path) -> tuple[dict[str, ExportedSurface], dict[str, NDArray[np.int64]]]:
    try:
        with np.load(BytesIO(read_file(path, _NPZ_BYTES_MAX, what="file"))) as file:
            size = sum(each.file_size for each in file.zip.infolist())
            if size > FRAME_BYTES_MAX:
                raise ValueError(f"expected {FRAME_BYTES_MAX} bytes at most in its arrays, got {size}")
            arrays = {key: _checked(key, file[key]) for key in file.files if _part(key) in _ARRAYS}
        surfaces = {
            name: ExportedSurface(
                tuple(degree), tuple(window), **{part: arrays[f"{name}_{part}"] for part in _OF_A_SURFACE}
            )
            for name, degree, window in zip(
                *(arrays[key].tolist() for key in ("names", "degree", "window")), strict=True
            )
        }
        measured = {
            key.removesuffix("_measured"): np.cumsum(array, dtype=np.int64)
            for key, array in arrays.items()
            if key.endswith("_measured")
        }
    except KeyError as err:
        raise DamagedExportError(path, f"{err} is missing") from err
    # What NumPy and zipfile raise for damaged files is of many kinds, some of them without a text.
    except Exception as err:
        raise DamagedExportError(path, str(err) or type(err).__name__) from err
    return surfaces, measured


def _part(key: str) -> str:
    """Return what an array is, without the segment it is of: ``knots_u`` of ``P0_knots_u``."""
    return key.partition("_")[2] or key


def _checked(key: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return an array; raises ValueError if it is of another kind or shape than its name says."""
    kind, dimensions, columns = _ARRAYS[_part(key)]
    if array.dtype.kind != kind or array.ndim != dimensions or columns not in (0, array.shape[-1]):
        raise ValueError(f"{key}: is an array {array.shape} of {array.dtype}, not as in docs/files.md")
    return array
