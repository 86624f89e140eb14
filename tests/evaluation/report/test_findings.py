"""Sentences about tables are made from the tables."""

import math
import re
from pathlib import Path

import pytest

from nurbseg.evaluation.report.findings import as_markdown, as_text, findings, summary_rows, verdict
from nurbseg.evaluation.results import StudyResults
from nurbseg.evaluation.variants import variants_of
from nurbseg.segmentation.config import SegmentationConfig

DOCS = Path(__file__).parents[3] / "docs"


def test_methods_are_ranked_by_their_best_settings_and_settings_by_their_scores():
    names = ("a mse T=1.0", "a mse T=0.9", "b", "c")
    means = {
        "ri": dict(zip(names, (0.5, 0.7, 0.6, 0.9), strict=True)),
        "gtrc": dict(zip(names, (0.4004, 0.4001, 0.3, 0.2), strict=True)),
        "voi": dict(zip(names, (1.0, 2.0, 0.5, 3.0), strict=True)),
        "obj": dict(zip(names, (math.nan, math.nan, 0.25, math.nan), strict=True)),
    }
    assert findings(means) == [
        "RI, the best setting of each method first: c 0.900, a mse T=0.9 0.700, b 0.600.",
        "GTRC, the best setting of each method first: a mse T=1.0 0.400, b 0.300, c 0.200.",
        "VoI (bits), the best setting of each method first: b 0.500, a mse T=1.0 1.000, c 3.000.",
        "obj, the best setting of each method first: b 0.250.",
        "a, from its best setting to its worst: RI from 0.700 (mse T=0.9) to 0.500 (mse T=1.0), "
        "GTRC from 0.400 (mse T=1.0) to 0.400 (mse T=0.9), VoI (bits) from 1.000 (mse T=1.0) to 2.000 "
        "(mse T=0.9).",
    ]


def test_names_are_aligned_to_the_left_and_figures_to_the_right():
    rows = [["variant", "mean"], ["a", "*0.5*"], ["b T=0.9", "-"]]
    assert as_text(rows) == "variant   mean\n--------------\na        *0.5*\nb T=0.9      -"
    assert as_markdown(rows).splitlines() == [
        "| variant | mean |",
        "| --- | ---: |",
        "| a | **0.5** |",
        "| b T=0.9 | - |",
    ]


def summary_of_page(page: str) -> list[dict[str, str]]:
    """Read the table of each method's settings."""
    table = page.split("**Each method with its first setting")[1].split("\n\n")[1].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    return [dict(zip(rows[0], row, strict=True)) for row in rows[2:]]


@pytest.mark.parametrize("name", ["results-mosd.md"])
def test_what_a_published_page_says_first_is_what_its_table_says(name: str):
    page = (DOCS / name).read_text(encoding="utf-8")
    best: dict[str, float] = {}
    for row in summary_of_page(page):
        assert row["95 % interval of GTRC"].split(" to ")[0] <= row["GTRC"]
        method = row["variant"].split()[0]
        best[method] = max(best.get(method, 0.0), float(row["GTRC"]))
    (said,) = re.findall(r"\n- GTRC, the best setting of each method first: (.*)\.\n", page)
    told = {word.split()[0]: float(word.split()[-1]) for word in said.split(", ")}
    assert told == best
    assert list(told.values()) == sorted(best.values(), reverse=True)
    # Settings may follow the name of either.
    verdict = re.search(r"Verdict: (\S+) [^(]*\(GTRC \S+\) .*? (?:of|from) (\S+) [^(]*\(\S+\):", page)
    assert verdict is not None
    first, second = verdict.groups()
    assert list(told)[:2] == [first, second]


def results_of(scores: dict[str, list[float]]) -> StudyResults:
    """Results of methods by their GTRC on each frame."""
    base = SegmentationConfig()
    variants = variants_of(list(scores), metrics=["mse"], thresholds=[1.0], grid={}, base=base)
    frames = [
        {"results": {variant.key: {"gtrc": scores[variant.method][frame]} for variant in variants}}
        for frame in range(len(next(iter(scores.values()))))
    ]
    return StudyResults(tuple(variants), tuple(frames), ())


def test_the_verdict_says_who_is_ahead_and_whether_that_is_sure():
    unsure = verdict(results_of({"fh04": [0.8, 0.7, 0.9, 0.8], "kmeans": [0.6, 0.7, 0.8, 1.0]}))
    assert unsure.startswith("Verdict: fh04 (GTRC 0.800) cannot be told apart from kmeans (0.775): ")
    assert "better on 2 of 4 frames, by 0.025 in the mean" in unsure
    sure = verdict(results_of({"kmeans": [0.5, 0.4, 0.5, 0.6], "fh04": [0.8, 0.7, 0.9, 0.8]}))
    assert sure.startswith("Verdict: fh04 (GTRC 0.800) is ahead of kmeans (0.500): better on 4 of 4 frames")
    alone = verdict(results_of({"fh04": [0.5, 0.75]}))
    assert alone == "Verdict: fh04 (GTRC 0.625) is the best setting that was tried, on 2 frames."


def test_the_verdict_compares_the_settings_of_one_method():
    base = SegmentationConfig()
    one, other = variants_of(["nurbseg"], metrics=["mse", "vgc"], thresholds=[1.0], grid={}, base=base)
    frames = tuple(
        {"results": {one.key: {"gtrc": mse}, other.key: {"gtrc": vgc}}}
        for mse, vgc in ((0.9, 0.95), (0.8, 0.7), (0.7, 0.85))
    )
    said = verdict(StudyResults((one, other), frames, ()))
    unsure = f"Verdict: {other.name} (GTRC 0.833) cannot be told apart from {one.name} (0.800): "
    assert said.startswith(unsure)
    assert "better on 2 of 3 frames, by 0.033 in the mean" in said


def test_the_summary_has_each_method_with_its_first_and_its_best_setting():
    base = SegmentationConfig()
    variants = variants_of(
        ["stag15", "fh04"], metrics=["mse"], thresholds=[1.0, 0.9, 0.8], grid={}, base=base
    )
    gtrc = {"stag15 mse T=1.0": 0.5, "stag15 mse T=0.9": 0.4, "stag15 mse T=0.8": 0.7, "fh04": 0.25}
    others = {"ri": 0.5, "voi": 2.0, "obj": None, "found": 1.0, "segments": 3}
    frame = {"results": {variant.key: {**others, "gtrc": gtrc[variant.name]} for variant in variants}}
    heading, *rows = summary_rows(StudyResults(tuple(variants), (frame,), ()), {"fh04": 0.0301})
    scores = ["RI", "GTRC", "VoI (bits)", "obj", "found"]
    assert heading == ["variant", *scores, "95 % interval of GTRC", "segments", "ms/frame"]
    assert [row[0] for row in rows] == ["stag15 mse T=1.0", "stag15 mse T=0.8", "fh04"]
    assert rows[1][1:] == ["0.500", "0.700", "2.000", "-", "1.000", "0.700 to 0.700", "3.0", ""]
    assert rows[2][-1] == "30"
