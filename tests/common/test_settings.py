"""Settings and values at the edge of what is possible: refused by name where they would do harm."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from nurbseg.app.settings.app_config import AppConfig, SourceConfig
from nurbseg.common.settings import (
    Settings,
    assigned,
    changed_paths,
    checked,
    setting,
    setting_paths,
    updated,
)
from nurbseg.drivers import Intrinsics, SourceOptions
from nurbseg.segmentation.config import SegmentationConfig

INFINITE, NAN = float("inf"), float("nan")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("extended.knot_spacing_px", 1.0001),
        ("extended.knot_spacing_px", INFINITE),
        ("extended.knot_spacing_px", NAN),
        ("extended.knot_spacing_px", None),
        ("affinity_scale", 1e300),
        ("affinity_scale", 1e-300),
        ("geometry_weight", INFINITE),
        ("extended.log_odds_min", -INFINITE),
        ("extended.smoothness", NAN),
        ("decimation", None),
        ("method", None),
        ("seed", True),
        ("seed", 1.5),
        ("extended.fold_surfaces", 1),
        ("extended.up", 3),
    ],
)
def test_a_setting_that_cannot_be_worked_with_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected .* got {re.escape(str(value))}"):
        updated(SegmentationConfig(), **{name: value})


@pytest.mark.parametrize("name", ["width", "height", "fx", "cy"])
@pytest.mark.parametrize("value", [INFINITE, NAN, None, "640"])
def test_intrinsics_that_are_no_numbers_are_refused_by_name(name: str, value: Any) -> None:
    values: dict[str, Any] = {"width": 64, "height": 48, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    with pytest.raises(ValueError, match=f"^{name}: expected .* got {value}"):
        Intrinsics(**values | {name: value})


def test_an_infinite_association_limit_is_refused() -> None:
    with pytest.raises(ValueError, match="association_limit_s: expected seconds over 0, got inf"):
        SourceOptions(association_limit_s=INFINITE)


def test_a_whole_number_of_hundreds_of_digits_is_refused_in_few_words():
    @dataclass
    class Numbers(Settings):
        count: int = setting(1, "a number", least=0)

    with pytest.raises(ValueError, match=r"count: expected a whole number, at least 0, got 1000") as refused:
        Numbers(count=10**400)
    assert len(str(refused.value)) < 150


def test_a_whole_number_for_a_setting_that_is_none_is_taken_as_what_it_is_declared_to_be():
    changes = {"geometry_weight": np.float32(2), "seed": np.int64(3), "extended.smoothness": 1}
    config = updated(SegmentationConfig(), **changes)
    assert [type(each) for each in (config.geometry_weight, config.seed, config.extended.smoothness)] == [
        float,
        int,
        float,
    ]


@pytest.mark.parametrize("text", ["", "all", "auto ", "automatic", "zero", "3.5"])
def test_only_its_own_word_stands_for_a_number(text: str) -> None:
    for name, words in ("workers", "a whole number or auto"), ("start", "a whole number"):
        with pytest.raises(ValueError, match=f"^{name}: expected {words}, at least"):
            assigned(SourceConfig, f"{name}={text}")
    assert [assigned(SourceConfig, f"workers={word}")[1] for word in ("auto", "3")] == ["auto", 3]


def test_every_default_is_one_that_its_setting_takes() -> None:
    for path, each in setting_paths(AppConfig):
        found = checked(each, each.default)
        assert (found, type(found)) == (each.default, type(each.default)), path


def test_settings_that_are_not_at_their_defaults_are_told_by_path() -> None:
    config = updated(SegmentationConfig(), samples=50, depth_max=30, method="stag15", extended={"cuts": 1})
    assert set(changed_paths(config)) == {"samples", "depth_max", "method", "extended.cuts"}
    assert changed_paths(SegmentationConfig()) == []
