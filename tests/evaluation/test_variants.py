"""Spelling out what is compared."""

from pathlib import Path

import pytest

from nurbseg.evaluation.variants import grid_of, variants_of
from nurbseg.segmentation.config import SegmentationConfig


def test_the_paper_s_grid_has_27_settings() -> None:
    metrics = ["mse", "mae", "ve", "nle", "vmxc", "vmec", "vgc", "mmxc", "nlc"]
    variants = variants_of(["stag15"], metrics=metrics, thresholds=[1.0, 0.9, 0.8])
    assert len(variants) == 27
    assert len({variant.key for variant in variants}) == 27
    assert variants[1].name == "stag15 mse T=0.9"
    assert variants[1].config.ratio_max == 0.9


def test_rivals_and_the_earlier_method_stand_outside_the_grid_of_metrics() -> None:
    variants = variants_of(["fh04", "pz14"], metrics=["mse", "nle"], thresholds=[1.0, 0.9])
    assert [variant.name for variant in variants] == ["fh04", "pz14"]
    assert variants[1].config.stag15.control_points == "fixed"
    assert variants[1].config.metric == "mse"


def test_lambda_may_be_values_or_chosen_for_each_frame() -> None:
    variants = variants_of(["stag15"], grid=grid_of(["lambda=0.5,2,auto"]))
    assert [variant.config.geometry_weight for variant in variants[:2]] == [0.5, 2.0]
    assert variants[2].lambda_auto
    assert len({variant.key for variant in variants}) == 3


def test_the_key_of_a_rival_does_not_depend_on_settings_it_does_not_use() -> None:
    other = SegmentationConfig(geometry_weight=3.0)
    assert variants_of(["fh04"])[0].key == variants_of(["fh04"], base=other)[0].key
    assert variants_of(["stag15"])[0].key != variants_of(["stag15"], base=other)[0].key


def test_a_grid_gives_a_method_only_the_settings_it_uses() -> None:
    grid = grid_of(["lambda=0.5,auto", "samples=50,60", "control-points=fixed,adaptive"])
    names = [variant.name for variant in variants_of(["dmzc12", "fh04"], grid=grid)]
    assert names == ["dmzc12 samples=50", "dmzc12 samples=60", "fh04"]
    earlier = variants_of(["pz14"], grid=grid)
    assert len(earlier) == 4
    assert {each.config.stag15.control_points for each in earlier} == {"fixed"}
    assert {each.config.method for each in earlier} == {"stag15"}


def test_replaced_label_images_have_another_key(tmp_path: Path) -> None:
    image = tmp_path / "learn0_labels.png"
    image.write_bytes(b"first")
    (before,) = variants_of([f"labels:{tmp_path}"])
    (same,) = variants_of([f"labels:{tmp_path}"])
    image.write_bytes(b"second")
    (after,) = variants_of([f"labels:{tmp_path}"])
    assert before.key == same.key
    assert before.key != after.key
    assert before.name == after.name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("method=stag15", "use --methods"),
        ("lambda", "NAME=VALUE"),
        ("lamda=1", "no such setting"),
        ("samples=many", "expected a whole number, at least 2, at most 2000, got 'many'"),
        ("samples=1", "at least 2"),
        ("metric=best", "expected one of"),
    ],
)
def test_a_wrong_grid_says_what_is_wrong(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        grid_of([text])


def test_a_grid_varies_a_setting_for_the_methods_that_read_it() -> None:
    grid = grid_of(["noise_floor=0.5,1", "segment_pixels_min=700,800,900"])
    names = [variant.name for variant in variants_of(["nurbseg", "stag15"], grid=grid)]
    assert names == [
        "nurbseg noise_floor=0.5",
        "nurbseg noise_floor=1.0",
        *(f"stag15 segment_pixels_min={pixels}" for pixels in (700, 800, 900)),
    ]
