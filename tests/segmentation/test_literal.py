"""The paper's method gives what its text gives where it is followed literally: `benchmarks/literal.py`."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig, Stag15Config
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap

SHAPE = (60, 80)


@pytest.fixture(scope="module")
def literal():
    pytest.importorskip("skimage")
    path = Path(__file__).parents[2] / "benchmarks" / "literal.py"
    spec = importlib.util.spec_from_file_location("literal", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def box_and_ball_before_a_floor(seed: int) -> PointMap:
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth, color = 2.0 - 0.006 * rows, np.full((*SHAPE, 3), 120.0)
    depth[15:40, 10:32] = 1.3 + 0.004 * columns[15:40, 10:32]
    color[15:40, 10:32] = 200, 60, 40
    square = 169.0 - (rows - 34) ** 2 - (columns - 56) ** 2
    depth[square > 0] = 1.5 - 0.02 * np.sqrt(square[square > 0])
    color[square > 0] = 40, 90, 200
    depth += rng.normal(0.0, 0.004, SHAPE)
    color = np.clip(color + rng.normal(0.0, 6.0, color.shape), 0, 255).astype(np.uint8)
    depth[rng.random(SHAPE) < 0.03] = np.nan
    points = np.stack([(columns - 40) / 70 * depth, (rows - 30) / 70 * depth, depth], axis=-1)
    return PointMap(points.astype(np.float32), color, np.ones(SHAPE, dtype=np.bool_))


@pytest.mark.parametrize("seed", range(5))
def test_the_tree_is_that_of_the_papers_text(literal, seed):
    cloud = box_and_ball_before_a_floor(seed)
    config = SegmentationConfig(
        method="stag15",
        decimation=1,
        samples=60,
        splits_max=8,
        seed=seed,
        stag15=Stag15Config(segment_pixels_min=6000, least_squares="svd", control_points_max=12),
    )
    expected, tree = literal.tree(cloud, config), segment(cloud, config)
    assert {each.name for each in tree.segments} == set(expected)
    assert len(expected) > 10
    for name, (pixels, error) in expected.items():
        assert np.array_equal(np.sort(tree[name].pixels), pixels)
        assert tree[name].fit.values["mse"] == pytest.approx(error, rel=1e-9)
    assert np.array_equal(tree.labels(), literal.segment(cloud, config))
