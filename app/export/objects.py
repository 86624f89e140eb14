"""The objects of a frame as JSON, and those of all frames as a table."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nurbseg.common.files import append, open_regular, write_atomically
from nurbseg.common.frame import Intrinsics
from nurbseg.segmentation.vocabulary import display_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from nurbseg.library.boxes.boxes import OrientedBox
    from nurbseg.library.boxes.support import Support
    from nurbseg.library.objects import MeasuredObject
    from nurbseg.library.result import FrameResult

#: Description of the coordinates.
CONVENTION = "depth camera, meters: x right, y down, z forward; pixel centers at whole numbers (column, row)"
#: Columns of the table, by their keys in the documents of a frame and of an object.
_OF_FRAME = ("frame", "name", "timestamp_ns")
_VECTORS = {
    "centroid_m": "xyz",
    "size_m": "123",
    "center_m": "xyz",
    "axis_1": "xyz",
    "axis_2": "xyz",
    "axis_3": "xyz",
    "normal": "xyz",
    "color": "rgb",
}
_SIGMA = ("center_m", "size_m", "yaw_rad")
COLUMNS = (
    *_OF_FRAME,
    "object",
    "pixels",
    *(f"{name}_{axis}" for name, axes in _VECTORS.items() for axis in axes),
    "rms_m",
    *(f"sigma_{name}" for name in _SIGMA),
    "leaves",
)


def objects_document(result: FrameResult) -> dict[str, Any]:
    """Return the measurements of a frame's objects, its camera and the convention of coordinates."""
    frame = result.frame
    return {
        "frame": frame.index,
        "name": frame.name,
        "timestamp_ns": frame.timestamp_ns,
        "coordinates": CONVENTION,
        "camera": _camera_document(frame.calibration.depth),
        "level": "objects" if result.tree.objects else "surfaces",
        "support": _support_document(result.objects[0].support if result.objects else None),
        "objects": [object_document(each) for each in result.objects],
    }


def object_document(each: MeasuredObject) -> dict[str, Any]:
    """Return the measurements of an object."""
    pose = each.support_from_object
    return {
        "object": each.label,
        "pixels": int(each.pixels.size),
        "centroid_m": _rounded(each.centroid_m),
        "box": _box_document(each.box),
        "visible": _box_document(each.visible),
        "sigma": {name: round(getattr(each.sigma, name), 6) for name in _SIGMA},
        "support_from_object": None if pose is None else [_rounded(row) for row in pose],
        "velocity_m_s": [round(value, 6) for value in each.track.velocity_m_s],
        "seen_s": round(each.track.seen_s, 6),
        "normal": None if each.mean_normal is None else _rounded(each.mean_normal),
        "color": _rounded(each.mean_color, 2),
        "rms_m": None if each.rms_m is None else round(each.rms_m, 7),
        "rms_over_noise": round(each.rms_over_noise, 4),
        "hidden_share": round(each.hidden_share, 4),
        "pending": each.pending,
        "sure": each.is_sure,
        "leaves": [display_name(name) for name in each.leaves],
    }


def _box_document(box: OrientedBox) -> dict[str, Any]:
    return {
        "center_m": _rounded(box.center_m),
        "size_m": _rounded(box.size_m),
        "axes": [_rounded(axis) for axis in box.axes],
    }


def _support_document(support: Support | None) -> dict[str, Any] | None:
    if support is None:
        return None
    return {
        "normal": _rounded(support.normal),
        "camera_height_m": round(support.camera_height_m, 6),
        "found_by": support.found_by,
    }


def _camera_document(camera: Intrinsics) -> dict[str, Any]:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {name: getattr(camera, name) for name in names} | {"distortion": camera.distortion.tolist()}


def _rounded(values: NDArray[np.floating], digits: int = 6) -> list[float]:
    return [round(float(value), digits) for value in values]


class ObjectTable:
    """A CSV table with a row for each object of each frame.

    Rows of an existing table are kept up to the first frame that is added.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._begun = False

    def add(self, document: Mapping[str, Any]) -> None:
        """Add the objects of a frame from its `objects_document`."""
        if not self._begun:
            self._begin(int(document["frame"]))
            self._begun = True
        append(self._path, _lines(_rows(document)).encode())

    def _begin(self, frame: int) -> None:
        """Write the header, and rows of an existing table before the first frame."""
        rows: list[Sequence[Any]] = [COLUMNS]
        if self._path.exists():
            with io.TextIOWrapper(open_regular(self._path, what="table"), "utf-8", newline="") as file:
                # The last line of a killed run may be incomplete.
                before = (row for row in csv.reader(file) if len(row) == len(COLUMNS))
                rows += [row for row in before if re.fullmatch("[0-9]{1,19}", row[0]) and int(row[0]) < frame]
        write_atomically(self._path, _lines(rows).encode())


def _rows(document: Mapping[str, Any]) -> list[Sequence[Any]]:
    rows: list[Sequence[Any]] = []
    for each in document["objects"]:
        values = each | each["box"]
        values |= {f"axis_{n}": axis for n, axis in enumerate(each["box"]["axes"], start=1)}
        vectors = [value for name, axes in _VECTORS.items() for value in values[name] or [""] * len(axes)]
        of_frame = [document[name] for name in _OF_FRAME]
        alone = (each["rms_m"], *(each["sigma"][name] for name in _SIGMA), " ".join(each["leaves"]))
        rows.append([*of_frame, each["object"], each["pixels"], *vectors, *alone])
    return rows


def _lines(rows: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
