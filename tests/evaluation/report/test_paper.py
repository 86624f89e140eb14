"""Tables for papers."""

from dataclasses import replace
from pathlib import Path

import pytest

from nurbseg.evaluation.eval_command import main
from nurbseg.evaluation.report.latex import latex_table
from nurbseg.evaluation.results import StudyResults
from nurbseg.evaluation.scoring.frame import FrameScores
from nurbseg.evaluation.scoring.objects import ObjectScores
from nurbseg.evaluation.variants import variants_of


@pytest.fixture(scope="module")
def study(lasting_frames: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "whole"
    words = ["run", str(lasting_frames), "--methods", "fh04,stag15", "--thresholds", "1,0.9", "--frames", "3"]
    assert main([*words, "--time-frames", "0", "--no-report", "--out", str(folder)]) == 0
    return folder


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


def test_a_study_has_a_row_of_each_setting_in_latex(study: Path) -> None:
    rows = (study / "tables.tex").read_text().splitlines()
    names = ["method", "fh04", "stag15 mse T=1.0", "stag15 mse T=0.9"]
    assert [row.partition(" & ")[0] for row in rows if " & " in row] == names
    assert "Ground truth: the regions as labeled" in rows[0]
