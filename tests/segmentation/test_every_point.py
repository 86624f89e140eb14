"""Whatever pixels have a point, these and no others have a label, by both methods and on every grid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig, Stag15Config
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap

HEIGHT, WIDTH = 23, 31


@st.composite
def clouds(draw):
    """Points of two walls, one before the other, at random pixels, rows and columns of a small image."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    share = draw(st.sampled_from([0.0, 0.01, 0.1, 0.5, 0.9, 1.0]))
    valid = rng.random((HEIGHT, WIDTH)) < share
    for axis, most in ((0, HEIGHT), (1, WIDTH)):
        lines = draw(st.lists(st.integers(0, most - 1), max_size=2))
        if draw(st.booleans()):
            valid[(slice(None),) * axis + (lines,)] = True
        else:
            valid[(slice(None),) * axis + (lines,)] = False
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    depth_m = np.where(
        columns < draw(st.integers(0, WIDTH)), 1.0, 1.0 + draw(st.sampled_from([0.0, 0.05, 1.0]))
    )
    depth_m = depth_m + rng.normal(0.0, 2e-3, depth_m.shape)
    rays = np.stack([(columns - 15.0) / 25.0, (rows - 11.0) / 25.0, np.ones(valid.shape)], axis=-1)
    points_m = np.where(valid[..., np.newaxis], rays * depth_m[..., np.newaxis], np.nan).astype(np.float32)
    color = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    return PointMap(points_m, color, valid)


@pytest.mark.parametrize("method", ["stag15", "nurbseg"])
@settings(max_examples=60)
@given(cloud=clouds(), decimation=st.integers(1, 3), least=st.sampled_from([100, 2_000, 20_000]))
def test_a_pixel_has_a_label_where_it_has_a_point_and_nowhere_else(method, cloud, decimation, least):
    config = SegmentationConfig(
        method=method,
        decimation=decimation,
        samples=20,
        stag15=Stag15Config(segment_pixels_min=least),
        extended=ExtendedConfig(piece_pixels_min=least),
    )
    tree = segment(cloud, config)
    for level in ("surfaces", "objects"):
        assert np.array_equal(tree.labels(level) > 0, cloud.valid)
