"""Figures and tables for papers."""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from nurbseg.evaluation.eval_command import main
from nurbseg.evaluation.report.latex import latex_table
from nurbseg.evaluation.results import StudyResults
from nurbseg.evaluation.scoring.frame import FrameScores
from nurbseg.evaluation.scoring.objects import ObjectScores
from nurbseg.evaluation.variants import variants_of

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def study(lasting_frames: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "whole"
    words = ["run", str(lasting_frames), "--methods", "fh04,stag15", "--thresholds", "1,0.9", "--frames", "3"]
    assert main([*words, "--time-frames", "0", "--no-report", "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize(("columns", "width_mm"), [(1, 85), (2, 174)])
def test_a_figure_is_as_wide_as_its_columns_and_the_same_each_time(
    study: Path, tmp_path: Path, columns: int, width_mm: float
) -> None:
    files = [tmp_path / f"{number}.pdf" for number in range(2)]
    for file in files:
        words = ["figure", str(study), "--frame", "2", "--columns", str(columns), "-o", str(file)]
        assert main(words) == 0
    content = files[0].read_bytes()
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) [\d.]+ ?\]", content)
    assert box is not None
    assert float(box[1]) / 72 * 25.4 == pytest.approx(width_mm, abs=0.1)
    assert content == files[1].read_bytes()


def test_a_figure_has_outlines_and_the_tree_as_vectors(study: Path, tmp_path: Path) -> None:
    words = ["figure", str(study), "--frame", "learn1", "--variant", "stag15 mse T=0.9"]
    assert main([*words, "-o", str(tmp_path / "a.svg")]) == 0
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    texts = ["".join(each.itertext()) for each in root.iter(f"{SVG}text")]
    assert "ground truth" in texts
    assert any("stag15 mse T=0.9" in text for text in texts)
    assert "P0" in " ".join(texts)
    assert len([*root.iter(f"{SVG}image")]) == 2
    # The box of the first panel: the wall is larger, and has no outline.
    first = root.find(f".//{SVG}g[@id='axes_1']")
    assert first is not None
    image = first.find(f".//{SVG}image")
    (outline,) = (each for each in first.iter(f"{SVG}path") if "stroke" in each.get("style", ""))
    points = np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", outline.get("d", "")), dtype=float)
    width, height = np.ptp(points, axis=0)
    assert image is not None
    # 40 x 35 of 96 x 72 pixels.
    assert width == pytest.approx(float(image.get("width", "")) * 40 / 96, rel=0.02)
    assert height == pytest.approx(float(image.get("height", "")) * 35 / 72, rel=0.02)
    left = points[:, 0].min() - float(image.get("x", ""))
    assert left == pytest.approx(float(image.get("width", "")) * 14 / 96, rel=0.02)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--frame", "learn9"], "--frame learn9: no such frame; expected one of learn0, learn1, learn2"),
        (["--frame", "1", "--variant", "x"], "--variant x: expected one of fh04, stag15 mse T=1.0, stag15"),
        (["--frame", "1", "-o", "a.docx"], "docx"),
    ],
)
def test_what_a_figure_lacks_is_named(
    study: Path, words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["figure", str(study), *words]) == 2
    assert text in capsys.readouterr().err


def test_another_folder_is_no_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["figure", str(tmp_path), "--frame", "0"]) == 2
    assert f"{tmp_path}/study.json: does not exist: expected a folder that" in capsys.readouterr().err


def results_of(scores: dict[str, dict[str, float]]) -> StudyResults:
    variants = variants_of(list(scores))
    none = dict.fromkeys((*FrameScores._fields, *ObjectScores._fields), float("nan"))
    results = {variant.key: none | scores[variant.name] for variant in variants}
    variants = tuple(
        replace(variant, name=variant.name.replace("slic-ncut", "own_50%")) for variant in variants
    )
    return StudyResults(variants, ({"category": "a", "results": results},), ())


def test_the_best_of_each_column_is_bold_and_special_letters_are_escaped() -> None:
    results = results_of(
        {
            "fh04": {"ri": 0.9, "gtrc": 0.5004, "voi": 0.3, "found": 0.25},
            "slic-ncut": {"ri": 0.8, "gtrc": 0.5001, "voi": 0.2, "found": 0.5},
        }
    )
    table = latex_table(results, {"fh04": 0.0124}, "1 frame,\n100 % seen_here")
    assert table.splitlines() == [
        "% 1 frame, 100 % seen_here",
        r"% \usepackage{booktabs}",
        r"\begin{tabular}{lrrrrrr}",
        r"\toprule",
        r"method & RI $\uparrow$ & GTRC $\uparrow$ & VoI $\downarrow$ & obj $\uparrow$ & found $\uparrow$ & "
        r"ms $\downarrow$ \\",
        r"\midrule",
        r"fh04 & \textbf{0.900} & \textbf{0.500} & 0.300 & -- & 0.250 & \textbf{12} \\",
        r"own\_50\% & 0.800 & \textbf{0.500} & \textbf{0.200} & -- & \textbf{0.500} & -- \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_a_study_has_a_row_of_each_method_in_latex(study: Path) -> None:
    rows = (study / "tables.tex").read_text().splitlines()
    assert [row.split()[0] for row in rows if " & " in row] == ["method", "fh04", "stag15"]
    assert "Ground truth: the regions as labeled" in rows[0]
