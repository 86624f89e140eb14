"""Inverse depths and distances of every few rows and columns of a frame."""

import numpy as np
from numpy.testing import assert_allclose

from nurbseg.segmentation.points.depth_grid import depth_grid, inverse_depth_image
from nurbseg.segmentation.points.registration import PointMap


def test_only_points_in_front_of_the_camera_have_an_inverse_depth(cloud_of):
    rng = np.random.default_rng(0)
    points_m = rng.uniform(0.5, 3.0, (12, 17, 3)).astype(np.float32)
    points_m[rng.random((12, 17)) < 0.2] = np.nan
    points_m[2:6, 4, 2], points_m[2:6, 9, 2] = 0.0, -1.5
    other = cloud_of(np.ones((12, 17)))
    cloud = PointMap(points_m, other.color, other.colored, other.rays)
    in_front = points_m[..., 2] > 0
    expected = np.divide(1.0, points_m[..., 2], out=np.zeros((12, 17), np.float32), where=in_front)
    assert_allclose(inverse_depth_image(cloud), expected)
    grid = depth_grid(cloud, 3)
    assert_allclose(grid.inverse_depth, expected[::3, ::3])
    there = grid.valid
    assert_allclose(grid.distances_m[there], np.linalg.norm(points_m[::3, ::3][there], axis=1), rtol=1e-6)
