"""Middles and planes of surfaces whose shape is known."""

import numpy as np
import pytest

from nurbseg.segmentation.objects.agglomeration import scene_of
from nurbseg.segmentation.objects.surface_statistics import (
    COUNT,
    X,
    Z,
    along,
    extents,
    plane,
    surface_statistics,
)
from nurbseg.segmentation.points.grid import depth_grid

SIZE = (120, 160)
#: Planes n . p = 1 of three walls, none of which goes through the camera.
PLANES = np.array([[0.3, 0.1, 0.9], [-0.5, 0.2, 1.1], [0.1, -0.8, 0.7]])


@pytest.fixture
def walls(rays_of_size):
    """Inverse depth of three walls side by side, and which is seen where."""
    labels = np.repeat([1, 2, 3], [50, 60, 50])[np.newaxis].repeat(SIZE[0], axis=0).astype(np.int32)
    per_m = np.einsum("hwc,hwc->hw", rays_of_size(SIZE), PLANES[labels - 1])
    return per_m, labels


def planes(found, grid):
    """Normal and residual of each label's plane."""
    camera = scene_of(found, grid, 2e-3).camera
    found = np.array([plane(own, camera) for own in found])
    return found[:, :3], found[:, 3]


@pytest.mark.parametrize("step", [1, 2])
def test_planes_have_their_normals_towards_the_camera(cloud_of, walls, step):
    per_m, labels = walls
    grid = depth_grid(cloud_of(1 / per_m), step)
    found = surface_statistics(labels[::step, ::step], 3, grid)
    towards = -PLANES / np.linalg.norm(PLANES, axis=1, keepdims=True)
    normals, rms_per_m = planes(found, grid)
    np.testing.assert_allclose(normals[1:], towards, atol=1e-4)
    assert rms_per_m.max() < 1e-4


@pytest.mark.parametrize("step", [1, 2])
def test_middles_and_sizes_are_those_of_the_points(cloud_of, walls, step):
    per_m, labels = walls
    cloud = cloud_of(1 / per_m)
    labels[40:60, 30:120] = 0
    found = surface_statistics(labels[::step, ::step], 4, depth_grid(cloud, step))
    for label in (1, 2, 3):
        own = (labels == label)[::step, ::step]
        middle = cloud.points_m[::step, ::step][own].astype(float).mean(axis=0)
        assert found[label, COUNT] == np.count_nonzero(own)
        np.testing.assert_allclose(found[label, X : Z + 1] / found[label, COUNT], middle, atol=1e-9)
    assert not found[4].any()


def test_extents_are_those_of_the_points(cloud_of, walls):
    per_m, labels = walls
    cloud = cloud_of(1 / per_m)
    found = surface_statistics(labels, 3, depth_grid(cloud, 1))
    # Two walls together are what their sums are together.
    for sums, own in ((found[2], labels == 2), (found[1] + found[2], labels < 3)):
        points = cloud.points_m[own].astype(float)
        scatter = np.linalg.eigvalsh(np.cov(points.T, bias=True))
        np.testing.assert_allclose(extents(sums), np.sqrt(np.maximum(scatter, 0)), atol=1e-5)
        direction = np.array([0.6, 0.0, 0.8])
        mean, deviation = along(sums, tuple(direction))
        assert mean == pytest.approx((points @ direction).mean(), abs=1e-6)
        assert deviation == pytest.approx((points @ direction).std(), abs=1e-6)


def test_the_plane_is_the_best_of_inverse_depth(cloud_of, rays_of_size):
    directions = rays_of_size(SIZE)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    per_m = 1.0 + 0.002 * columns + 1e-5 * (rows - 30) ** 2 + 0.01 * np.sin(columns / 7)
    # A slanted strip: columns and rows go together in it.
    strip = (abs(rows - 50 + 0.8 * (columns - 90)) < 12) & (abs(columns - 90) < 40)
    labels = strip.astype(np.int32)
    grid = depth_grid(cloud_of(1 / per_m), 1)
    normals, rms_per_m = planes(surface_statistics(labels, 1, grid), grid)
    own = labels == 1
    # A plane n . p = 1 has the inverse depth n . ray.
    best = np.linalg.lstsq(directions[own], per_m[own], rcond=None)[0]
    np.testing.assert_allclose(normals[1], -best / np.linalg.norm(best), atol=1e-4)
    assert rms_per_m[1] == pytest.approx(np.std(directions[own] @ best - per_m[own]), rel=1e-3)


def test_a_single_row_of_points_has_a_plane(cloud_of, walls):
    per_m, labels = walls
    labels[np.arange(SIZE[0]) != 20] = 0
    grid = depth_grid(cloud_of(1 / per_m), 1)
    normals, rms_per_m = planes(surface_statistics(labels, 3, grid), grid)
    assert np.isfinite(normals).all() and np.isfinite(rms_per_m).all()
    np.testing.assert_allclose(np.linalg.norm(normals[1:], axis=1), 1.0)
