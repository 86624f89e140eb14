"""The ratio of eq. 5 decides in the default method: metrics count as no less than noise leaves of them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.extended.parts import judge_split
from nurbseg.segmentation.judged import JudgedSplit
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.surface import evaluate
from nurbseg.segmentation.vocabulary import Division, StopReason

# Surfaces so stiff that none follows a shallow roof, and the noise that it is given.
CONFIG = SegmentationConfig(
    method="nurbseg",
    decimation=1,
    extended=ExtendedConfig(
        refine_borders=False, knot_spacing_px=50.0, smoothness=1.0, inverse_depth_noise=2.5e-3
    ),
)
SIZE = (120, 160)


def roof(turn: float, noise_per_m: float = 2.5e-3, seed: int = 0) -> NDArray[np.float64]:
    """Depth of two planes that meet in the middle; their slopes differ by so much, 1/m per pixel."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    inverse_depth = 1.6 + 0.0005 * rows - 0.5 * turn * np.abs(columns - 79.5)
    return 1 / (inverse_depth + noise_per_m * np.random.default_rng(seed).normal(size=SIZE))


def weight(fit: Fit, cloud: PointMap, noise_per_m: float) -> float:
    """Sum of squared distances to a surface (eq. 7), or of noise, three times as large at the rim."""
    rows, columns = np.unravel_index(fit.pixels, cloud.valid.shape)
    assert fit.surface is not None
    points = cloud.points_m[rows, columns].astype(float)
    squares = np.sum((evaluate(fit.surface, columns.astype(float), rows.astype(float)) - points) ** 2)
    held = np.zeros((cloud.valid.shape[0] + 2, cloud.valid.shape[1] + 2), dtype=bool)
    held[rows + 1, columns + 1] = True
    inner = np.all([held[rows + i, columns + j] for i in range(3) for j in range(3)], axis=0)
    noise = noise_per_m * np.where(inner, 1.0, 3.0) * points[:, 2] * np.linalg.norm(points, axis=1)
    return max(float(squares), float(np.sum(noise**2)))


def cut_at_middle(tree: SegmentationTree) -> bool:
    """Say whether no leaf lies on both sides of the middle column, by more than a few pixels."""
    labels = tree.labels("surfaces")
    left, right = set(np.unique(labels[:, :76])), set(np.unique(labels[:, 84:]))
    return not left & right


def test_two_planes_at_an_angle_are_separated_by_their_ratio(cloud_of):
    cloud = cloud_of(roof(0.02))
    tree = segment(cloud, CONFIG)
    assert cut_at_middle(tree)
    root = tree.root
    assert root.division is Division.CUT
    weights = [weight(tree[name].fit, cloud, CONFIG.extended.inverse_depth_noise) for name in root.children]
    assert root.ratio == pytest.approx(
        sum(weights) / weight(root.fit, cloud, CONFIG.extended.inverse_depth_noise), rel=1e-3
    )
    assert root.ratio < 0.9


@pytest.mark.parametrize("seed", range(3))
def test_a_noisy_plane_stays_whole_since_its_ratio_is_one(cloud_of, seed):
    cloud = cloud_of(roof(0.0, seed=seed))
    tree = segment(cloud, CONFIG)
    assert [leaf.stop for leaf in tree.leaves()] == [StopReason.NOISE]
    # What the shortcut foretells, tried; with fewer landmarks a cut through noise is more ragged.
    judged: list[JudgedSplit] = []
    tried = replace(CONFIG, landmarks=CONFIG.samples, ratio_max=1.001)
    segment(cloud, tried, observe=judged.append)
    # The parts' floors are the whole's, and more along the cut, where both have a rim.
    ratios = [each.trial.ratio for each in judged if each.trial.points == cloud.valid.size]
    assert 1.0 <= min(ratios) < 1.25


def test_parts_at_their_floors_are_no_better_than_the_whole_by_rounding():
    # Floors of a count are in proportion to the points.
    parts = [(9.375127808575507e-12, 80), (4.453185709073366e-12, 38)]
    trial = judge_split((1.3828313517648874e-11, 118), parts, SegmentationConfig(metric="nlc"))
    assert trial.ratio < 1
    assert not trial.kept


def test_a_factor_on_the_noise_decides_what_is_noise(cloud_of):
    cloud = cloud_of(roof(0.0, noise_per_m=4e-3))
    tried = segment(cloud, CONFIG).root
    assert tried.ratio is not None
    untried = segment(cloud, updated(CONFIG, extended={"noise_floor": 2.0})).root
    assert (untried.stop, untried.ratio) == (StopReason.NOISE, None)


@pytest.mark.parametrize(
    ("ratio_max", "stop"),
    [(1.0, None), (0.9, None), (0.84, StopReason.CRITERION), (0.8, StopReason.NOISE)],
)
def test_what_is_tried_is_what_may_be_accepted(cloud_of, ratio_max, stop):
    # By this crease the plane's error is little above noise: floor over value is .824, the ratio .853.
    alone = {"protrusion_min": 0.0, "split_creases": False, "cuts": 1}
    root = segment(cloud_of(roof(0.012)), updated(CONFIG, ratio_max=ratio_max, extended=alone)).root
    assert root.fit.floor / root.fit.values["mse"] == pytest.approx(0.824, abs=0.002)
    assert root.stop is stop
    if stop is StopReason.NOISE:
        assert root.trial is None
    else:
        assert root.ratio == pytest.approx(0.853, abs=0.002)
