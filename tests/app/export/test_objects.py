"""The objects of a frame as a document, and those of all frames as a table."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.objects import COLUMNS, ObjectTable
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig


@pytest.fixture(scope="module")
def result(small_result: FrameResult) -> FrameResult:
    return process_frame(replace(small_result.frame, name="shelf", timestamp_ns=7), SegmentationConfig())


def test_the_document_agrees_with_the_label_image_and_the_points(result: FrameResult, tmp_path: Path) -> None:
    Exporter(tmp_path, RunSettings(SegmentationConfig()), ExportConfig(objects=True)).write(result)
    document = json.loads((tmp_path / "000000_objects.json").read_text())
    tree = json.loads((tmp_path / "000000_tree.json").read_text())
    assert (document["frame"], document["name"], document["timestamp_ns"]) == (0, "shelf", 7)
    assert document["level"] == "objects"
    assert "x right, y down, z forward" in document["coordinates"]
    camera = result.frame.calibration.depth
    assert document["camera"] == {
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "distortion": camera.distortion.tolist(),
    }
    labels = result.labels("objects")
    assert [each["object"] for each in document["objects"]] == np.unique(labels[labels > 0]).tolist()
    assert len(document["objects"]) > 3
    for each, of_tree in zip(document["objects"], tree["objects"], strict=True):
        mask = labels == each["object"]
        points = result.cloud.points_m[mask].astype(np.float64)
        assert each["pixels"] == np.count_nonzero(mask)
        assert each["leaves"] == of_tree["leaves"]
        assert np.allclose(each["centroid_m"], points.mean(axis=0), atol=1e-5)
        assert np.allclose(each["color"], result.cloud.color[mask].mean(axis=0), atol=0.01)
        box, axes = each["box"], np.array(each["box"]["axes"])
        assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-5)
        local = np.abs((points - box["center_m"]) @ axes.T)
        inside = (local <= 0.5 * np.array(box["size_m"]) + 0.002).all(axis=1)
        assert inside.mean() > 0.9
        assert np.allclose(2 * local[inside].max(axis=0), box["size_m"], atol=5e-3)
        # Where the camera looks, normals look back.
        assert np.dot(each["normal"], each["centroid_m"]) < 0
        assert np.linalg.norm(each["normal"]) == pytest.approx(1.0, abs=1e-5)


def document(frame: int, objects: int = 2) -> dict[str, Any]:
    box = {"center_m": [1.0, 2.0, 3.0], "size_m": [0.3, 0.2, 0.1], "axes": np.eye(3).tolist()}
    each = {"pixels": 9, "centroid_m": [4.0, 5.0, 6.0], "box": box, "normal": None, "color": [1.5, 2.5, 3.5]}
    sigma = {"center_m": 0.01, "size_m": 0.02, "yaw_rad": 0.03}
    each |= {"rms_m": 0.001, "leaves": ["P0", "P11"], "sigma": sigma}
    rows = [{"object": number + 1, **each} for number in range(objects)]
    return {"frame": frame, "name": "a, b", "timestamp_ns": 10**18 + frame, "objects": rows}


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_table_has_a_row_for_each_object_of_each_frame(tmp_path: Path) -> None:
    table = ObjectTable(tmp_path / "objects.csv")
    for frame in (3, 4):
        table.add(document(frame))
    rows = read(tmp_path / "objects.csv")
    assert [(row["frame"], row["object"]) for row in rows] == [("3", "1"), ("3", "2"), ("4", "1"), ("4", "2")]
    row = rows[0]
    assert (row["name"], row["timestamp_ns"]) == ("a, b", str(10**18 + 3))
    assert [row[f"centroid_m_{axis}"] for axis in "xyz"] == ["4.0", "5.0", "6.0"]
    assert [row[f"center_m_{axis}"] for axis in "xyz"] == ["1.0", "2.0", "3.0"]
    assert [row[f"size_m_{axis}"] for axis in "123"] == ["0.3", "0.2", "0.1"]
    assert [row[f"axis_2_{axis}"] for axis in "xyz"] == ["0.0", "1.0", "0.0"]
    assert [row[f"normal_{axis}"] for axis in "xyz"] == ["", "", ""]
    assert [row[f"color_{axis}"] for axis in "rgb"] == ["1.5", "2.5", "3.5"]
    assert (row["rms_m"], row["leaves"]) == ("0.001", "P0 P11")
    sigma = [row[f"sigma_{name}"] for name in ("center_m", "size_m", "yaw_rad")]
    assert sigma == ["0.01", "0.02", "0.03"]


def test_a_run_that_continues_keeps_the_rows_before_and_writes_none_twice(tmp_path: Path) -> None:
    path = tmp_path / "objects.csv"
    first = ObjectTable(path)
    for frame in range(4):
        first.add(document(frame))
    with path.open("a") as file:
        file.write(f"no number{',' * (len(COLUMNS) - 1)}\n")
        # More digits than Python converts.
        file.write(f"{'1' * 5000}{',' * (len(COLUMNS) - 1)}\n4,half a ro")
    second = ObjectTable(path)
    for frame in (2, 3, 4):
        second.add(document(frame, objects=1))
    assert [row["frame"] for row in read(path)] == ["0", "0", "1", "1", "2", "3", "4"]


def test_other_programs_read_the_table(tmp_path: Path) -> None:
    arrow = pytest.importorskip("pyarrow.csv")
    table = ObjectTable(tmp_path / "objects.csv")
    table.add(document(0))
    table.add(document(1, objects=0))
    read_back = arrow.read_csv(tmp_path / "objects.csv")
    assert tuple(read_back.column_names) == COLUMNS
    assert read_back["centroid_m_z"].to_pylist() == [6.0, 6.0]
