"""What a decision is called."""

from __future__ import annotations

import math
import re
from typing import get_args

import pytest

from nurbseg.library.contact_words import contact
from nurbseg.library.explanation import words
from nurbseg.segmentation.config import METRIC_UNITS, Metric
from nurbseg.segmentation.objects.merge import Contact


@pytest.mark.parametrize(
    ("parts", "metric", "ratio", "limit", "kept", "sentence"),
    [
        (2, "mse", 1 / 3.2, 1.0, True, "kept apart: two surfaces fit 3.2 times better"),
        (3, "mae", 0.05, 1.0, True, "kept apart: three surfaces fit 20 times better"),
        (2, "mse", 0.96, 1.0, True, "kept apart: two surfaces fit 4 % better"),
        (2, "mse", 0.9999, 1.0, True, "kept apart: two surfaces fit slightly better"),
        (12, "nle", 0.5, 1.0, True, "kept apart: 12 surfaces leave 2.0 times fewer points far off"),
        (2, "vgc", 0.5, 1.0, True, "kept apart: two surfaces bend 2.0 times more evenly"),
        (2, "mse", 0.0, 1.0, True, "kept apart: two surfaces explain everything"),
        (2, "mse", 1.1, 1.2, True, "kept apart: 1.10 is below 1.2"),
        (2, "mse", 1.04, 1.0, False, "not kept: 1.04 is not below 1"),
        (2, "mse", 1.0, 1.0, False, "not kept: 1.00 is not below 1"),
        (2, "mse", 1.0004, 1.0, False, "not kept: 1.0004 is not below 1"),
        (2, "mse", math.inf, 1.0, False, "not kept: one surface explains everything"),
        (2, "mse", 1.2, 1.0, True, "kept, although 1.20 is not below 1: the first split always is"),
    ],
)
def test_a_ratio_is_told_as_a_sentence(
    parts: int, metric: Metric, ratio: float, limit: float, kept: bool, sentence: str
) -> None:
    assert words.judged(parts, metric, ratio, limit, kept=kept, fold=False) == sentence


@pytest.mark.parametrize(
    ("metric", "value", "text"),
    [
        ("mse", 4.1e-6, "4.1 mm²"),
        ("mae", 0.0123, "12.3 mm"),
        ("nle", 1234.0, "1,234 points"),
        ("mmxc", 2.5, "2.5 1/m"),
    ],
)
def test_a_value_has_its_unit(metric: Metric, value: float, text: str) -> None:
    assert words.value_text(metric, value) == text


@pytest.mark.parametrize("metric", get_args(Metric))
def test_every_metric_has_its_words_and_unit(metric: Metric) -> None:
    better = words.judged(2, metric, 0.5, 1.0, kept=True, fold=False)
    assert re.match(r"kept apart: two surfaces (fit|leave|bend)( strongly at)? 2\.0 times [a-z]", better)
    # Residuals are told in millimeters.
    two = {"m": "2,000 mm", "m²": "2,000,000 mm²"}.get(METRIC_UNITS[metric], f"2 {METRIC_UNITS[metric]}")
    assert words.value_text(metric, 2.0) == two


def test_an_object_is_told_by_what_speaks_most_for_it() -> None:
    evidence = {"base": 1.08, "crease": 1.4, "size": -0.5, "gap": 1.7, "shape": 0.2}
    pair = Contact("01", "10", True, 30, 30, 3.88, evidence)
    assert words.merged(5, 2, pair) == (
        "object 5: two surfaces, since they touch and their edge is like one within an object"
    )
    assert contact(pair) == (
        "P01 and P10: log odds +3.88: they touch (+1.7), their edge is like one within an object (+1.4)"
    )
