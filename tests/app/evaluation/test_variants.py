"""Spelling out what is compared."""

import pytest

from nurbseg.app.evaluation.variants import grid_of, setting_value, variants_of
from nurbseg.segmentation.config import SegmentationConfig


def test_the_paper_s_grid_has_27_settings() -> None:
    metrics = ["mse", "mae", "ve", "nle", "vmxc", "vmec", "vgc", "mmxc", "nlc"]
    variants = variants_of(["stag15"], metrics=metrics, thresholds=[1.0, 0.9, 0.8])
    assert len(variants) == 27
    assert len({each.key for each in variants}) == 27
    assert variants[1].name == "stag15 mse T=0.9"
    assert variants[1].config.ratio_max == 0.9


def test_rivals_and_the_earlier_method_stand_outside_the_grid_of_metrics() -> None:
    variants = variants_of(["fh04", "pz14"], metrics=["mse", "nle"], thresholds=[1.0, 0.9])
    assert [each.name for each in variants] == ["fh04", "pz14"]
    assert variants[1].config.control_points == "fixed"
    assert variants[1].config.metric == "mse"


def test_lambda_may_be_values_or_chosen_for_each_frame() -> None:
    variants = variants_of(["stag15"], grid=grid_of(["lambda=0.5,2,auto"]))
    assert [each.config.geometry_weight for each in variants[:2]] == [0.5, 2.0]
    assert variants[2].lambda_auto
    assert len({each.key for each in variants}) == 3


def test_the_key_of_a_rival_does_not_depend_on_settings_it_does_not_use() -> None:
    other = SegmentationConfig(geometry_weight=3.0)
    assert variants_of(["fh04"])[0].key == variants_of(["fh04"], base=other)[0].key
    assert variants_of(["stag15"])[0].key != variants_of(["stag15"], base=other)[0].key


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lambda", "NAME=VALUE"),
        ("lamda=1", "no such setting"),
        ("samples=many", "expected a value like"),
        ("samples=1", "at least 2"),
        ("metric=best", "expected one of"),
    ],
)
def test_a_wrong_grid_says_what_is_wrong(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        grid_of([text])


def test_values_have_the_type_of_their_setting() -> None:
    assert setting_value("samples", "64") == 64
    assert setting_value("threshold", "0.9") == 0.9


def test_an_unknown_metric_is_refused() -> None:
    with pytest.raises(ValueError, match="mses"):
        variants_of(["stag15"], metrics=["mses"])
