"""The report and its pictures."""

import re
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet

from nurbseg.app.evaluation.cli import main
from nurbseg.app.evaluation.report.pictures import label_colors, tree_plot
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import register


def test_the_report_is_one_file_with_tables_plots_frames_and_trees(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["run", str(frames), "--methods", "stag15,fh04", "--thresholds", "1,0.9", "--out", str(out)]
    assert main([*words, "--time-frames", "1"]) == 0
    html = (out / "report.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', html)
    for heading in ("Scores against T", "Covering against time", "Frames, the worst", "Trees"):
        assert f"<h2>{heading}" in html
    assert html.count("<figcaption>ground truth") == 5
    assert 'class="best"' in html
    for name in ("threshold.png", "time.png"):
        assert cv2.imread(str(out / "pictures" / name)) is not None
    assert len(list((out / "pictures").glob("*-tree.png"))) == 5


def test_fits_are_drawn_where_a_tree_s_upper_segments_have_no_surface(frames: Path, tmp_path: Path) -> None:
    depth_path = frames / "learn0_depth.png"
    depth = cv2.imread(str(depth_path), cv2.IMREAD_UNCHANGED)
    # Two halves that nothing connects: the default method holds them together without a surface.
    depth[:, 40:56] = 0
    cv2.imwrite(str(depth_path), depth)
    with open_source(str(frames)) as source:
        tree = segment(register(source.read()), SegmentationConfig())
    assert tree.root.fit.surface is None
    out = tmp_path / "out"
    words = [str(frames), "--methods", "nurbseg", "--frames", "1", "--time-frames", "0"]
    assert main([*words, "--out", str(out)]) == 0
    errors = cv2.imread(str(out / "pictures" / "00-000000-learn0-errors.png"))
    assert errors is not None
    first_surfaces = errors[22:, 424:844]
    assert (first_surfaces > 0).any()


def test_the_rows_hold_every_frame_and_variant(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main([str(frames), "--methods", "stag15,fh04", "--out", str(out), "--no-report"]) == 0
    table = pyarrow.parquet.read_table(out / "results.parquet").to_pylist()
    assert len(table) == 10
    assert {row["category"] for row in table} == {"boxes"}
    assert all(0 <= row["gtrc"] <= 1 and row["voi"] >= 0 for row in table)
    assert len((out / "results.csv").read_text().splitlines()) == 11


def test_the_report_of_many_frames_shows_the_worst(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["run", str(frames), "--methods", "fh04", "--out", str(out), "--time-frames", "0"]
    assert main([*words, "--pictures", "2"]) == 0
    assert (out / "report.html").read_text().count("<figcaption>ground truth") == 2


def test_a_segment_bears_the_color_of_the_region_it_overlaps_most() -> None:
    truth = np.repeat(np.array([[1, 1, 2, 2]], np.uint16), 4, axis=0)
    labels = np.repeat(np.array([[9, 9, 9, 4]], np.uint16), 4, axis=0)
    own, theirs = label_colors(labels, truth), label_colors(truth, truth)
    np.testing.assert_array_equal(own[0, 0], theirs[0, 0])
    np.testing.assert_array_equal(own[0, 3], theirs[0, 3])


def test_a_tree_of_one_leaf_can_be_drawn() -> None:
    png = tree_plot([{"name": "", "stop": "criterion", "size": 9}])
    assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) is not None
