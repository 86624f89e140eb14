"""Checks the table of objects against the files of objects."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from nurbseg.app.export.exporter import OBJECTS_FILE
from nurbseg.common.files import read_file
from nurbseg.evaluation.check.exported import ExportedFrame, MeasuredObject
from nurbseg.evaluation.check.reading import DamagedExportError

#: Bytes of the table: 256 MiB, a day of a busy table.
_BYTES_MAX = 1 << 28


class ObjectRows:
    """The rows of the table of objects in a folder of exports, by frame.

    Raises DamagedExportError if the table cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / OBJECTS_FILE
        self.is_there = path.exists()
        self._rows: dict[str, list[dict[str, str]]] = {}
        if not self.is_there:
            return
        try:
            text = read_file(path, _BYTES_MAX, what="table").decode()
            for row in csv.DictReader(io.StringIO(text, newline=""), restval="", strict=True):
                self._rows.setdefault(row.get("frame") or "", []).append(row)
        except (ValueError, csv.Error) as err:
            raise DamagedExportError(path, f"not a table of objects: {err}") from err

    def check(self, frame: ExportedFrame) -> None:
        """Compare the rows of a frame with its file of objects, if both are there, cell by cell."""
        if not self.is_there or frame.objects_file is None:
            return
        rows = self._rows.get(str(frame.tree.frame), [])
        objects = frame.objects_file.objects
        labels = [str(each.object) for each in objects]
        if (found := [row.get("object") for row in rows]) != labels:
            frame.wrong_in_table("", "object", f"rows for {labels}, as in objects.json", found)
            return
        common = {"name": frame.objects_file.name, "timestamp_ns": frame.objects_file.timestamp_ns}
        for row, each in zip(rows, objects, strict=True):
            for column, expected in common.items() | dict(_cells(each)).items():
                cell = row.get(column)
                if not _is_same(cell, expected):
                    frame.wrong_in_table(
                        f"object {each.object}", column, f"{expected}, as in objects.json", cell
                    )


def _cells(each: MeasuredObject) -> Iterator[tuple[str, object]]:
    """Yield the columns of an object with what they should hold; None for an empty cell."""
    yield "pixels", each.pixels
    yield "rms_m", each.rms_m
    for name, value in each.sigma._asdict().items():
        yield f"sigma_{name}", value
    yield "leaves", " ".join(each.leaves)
    vectors = {
        "centroid_m": ("xyz", each.centroid_m),
        "size_m": ("123", each.box.size_m),
        "center_m": ("xyz", each.box.center_m),
        "normal": ("xyz", each.normal),
        "color": ("rgb", each.color),
    }
    vectors |= {f"axis_{n}": ("xyz", axis) for n, axis in enumerate(each.box.axes, start=1)}
    for name, (axes, values) in vectors.items():
        for axis, value in zip(axes, values or (None,) * len(axes), strict=True):
            yield f"{name}_{axis}", value


def _is_same(cell: str | None, expected: object) -> bool:
    if cell is None or expected is None:
        return cell == "" and expected is None
    if isinstance(expected, str):
        return cell == expected
    try:
        return float(cell) == expected
    except ValueError:
        return False
