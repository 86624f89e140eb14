"""The report and its pictures."""

import re
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pyarrow.parquet
import pytest

from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.eval_command import main
from nurbseg.evaluation.report import plots
from nurbseg.evaluation.report.pictures import label_colors
from nurbseg.evaluation.report.plots import metric_line, tree_plot
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import register


def test_the_report_is_one_file_with_tables_plots_frames_and_trees(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["run", str(frames), "--methods", "stag15,fh04", "--thresholds", "1,0.9", "--out", str(out)]
    assert main([*words, "--time-frames", "1"]) == 0
    html = (out / "report.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', html)
    for heading in ("Scores against T", "Frames, the worst", "Trees"):
        assert f"<h2>{heading}" in html
    assert html.count("<figcaption>ground truth") == 5
    assert 'class="best"' in html
    assert cv2.imread(str(out / "pictures" / "threshold.png")) is not None
    assert len(list((out / "pictures").glob("*-tree.png"))) == 5
    # Both thresholds of one method and another method: the best of each, and all behind a fold.
    tables = re.findall(r"<tbody>(.*?)</tbody>", html, re.DOTALL)
    assert [table.count("<tr>") for table in tables] == [2, 3]
    assert html.count("<summary>all 3 variants</summary>") == 1
    rows = [re.findall(r"<td(.*?)>(.*?)</td>", row) for row in tables[0].split("</tr>")[:2]]
    headings = re.findall(r"<th>(.*?)</th>", html)
    for score in ("RI", "VoI (bits)", "found"):
        column = headings.index(score)
        best = (min if score.startswith("VoI") else max)(float(row[column][1]) for row in rows)
        for kind, text in (row[column] for row in rows):
            assert ("best" in kind) == (float(text) == best)
    # What frames are sorted by.
    scores = [float(each) for each in re.findall(r'data-gtrc="(.*?)"', html)]
    assert len(scores) == 5
    assert scores == sorted(scores)


def test_a_method_has_a_color_and_a_metric_a_line(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = []
    drawn = plots._png_of
    monkeypatch.setattr(plots, "_png_of", lambda figure: figures.append(figure) or drawn(figure))
    words = ["run", str(frames), "--methods", "stag15,nurbseg,fh04", "--metrics", "mse,vgc"]
    words += ["--thresholds", "1,0.9", "--frames", "2", "--time-frames", "1"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    assert all(list(line.get_xdata()) == [0.9, 1.0] for line in figures[0].axes[0].lines)
    lines = {
        line.get_label(): (line.get_color(), line.get_linestyle(), line.get_marker())
        for line in figures[0].axes[0].lines
    }
    assert set(lines) == {
        f"{method} {metric}" for method in ("stag15", "nurbseg") for metric in ("mse", "vgc")
    }
    for method in ("stag15", "nurbseg"):
        assert lines[f"{method} mse"][0] == lines[f"{method} vgc"][0]
        assert lines[f"{method} mse"][1:] != lines[f"{method} vgc"][1:]
    for metric in ("mse", "vgc"):
        assert lines[f"stag15 {metric}"][1:] == lines[f"nurbseg {metric}"][1:]
        assert lines[f"stag15 {metric}"][0] != lines[f"nurbseg {metric}"][0]
    assert len({tuple(metric_line(each).items()) for each in get_args(Metric)}) == 9


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


@pytest.mark.parametrize("content", ["{", "{}", '{"segments": [{"name": "", "stop": "tired"}]}'])
def test_a_damaged_tree_of_the_study_is_named_with_what_to_do(
    frames: Path, tmp_path: Path, content: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        str(frames),
        "--methods",
        "stag15",
        "--frames",
        "1",
        "--time-frames",
        "0",
        "--out",
        str(tmp_path),
    ]
    assert main([*words, "--no-report"]) == 0
    (tree,) = tmp_path.glob("trees/*/*.json")
    tree.write_text(content)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert f"{tree}: cannot be drawn" in said and "remove it" in said


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


def test_a_segment_has_the_color_of_the_region_it_overlaps_most() -> None:
    truth = np.repeat(np.array([[1, 1, 2, 2]], np.uint16), 4, axis=0)
    labels = np.repeat(np.array([[9, 9, 9, 4]], np.uint16), 4, axis=0)
    own, theirs = label_colors(labels, truth), label_colors(truth, truth)
    np.testing.assert_array_equal(own[0, 0], theirs[0, 0])
    np.testing.assert_array_equal(own[0, 3], theirs[0, 3])


def test_a_tree_of_one_leaf_can_be_drawn() -> None:
    png = tree_plot([{"name": "", "stop": "criterion", "size": 9}])
    assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) is not None
