"""Middles and planes of surfaces whose shape is known."""

import numpy as np
import pytest

from nurbseg.segmentation.objects.surface_statistics import surface_statistics
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


@pytest.mark.parametrize("step", [1, 2])
def test_planes_have_their_normals_towards_the_camera(cloud_of, walls, step):
    per_m, labels = walls
    grid = depth_grid(cloud_of(1 / per_m), step)
    found = surface_statistics(labels[::step, ::step], 3, grid)
    towards = -PLANES / np.linalg.norm(PLANES, axis=1, keepdims=True)
    np.testing.assert_allclose(found.normal[1:], towards, atol=1e-4)


@pytest.mark.parametrize("step", [1, 2])
def test_middles_and_sizes_are_those_of_the_points(cloud_of, walls, step):
    per_m, labels = walls
    cloud = cloud_of(1 / per_m)
    labels[40:60, 30:120] = 0
    found = surface_statistics(labels[::step, ::step], 4, depth_grid(cloud, step))
    for label in (1, 2, 3):
        own = (labels == label)[::step, ::step]
        middle = cloud.points_m[::step, ::step][own].astype(float).mean(axis=0)
        np.testing.assert_allclose(found.center_m[label], middle, atol=1e-9)
        # The image is a quarter as wide as the one whose pixels are counted.
        assert found.pixels[label] == np.count_nonzero(own) * (step * 4) ** 2
    assert found.pixels[4] == 0
    assert not found.normal[4].any()


def test_the_plane_is_the_best_of_inverse_depth(cloud_of, rays_of_size):
    directions = rays_of_size(SIZE)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    per_m = 1.0 + 0.002 * columns + 1e-5 * (rows - 30) ** 2 + 0.01 * np.sin(columns / 7)
    # A slanted strip: columns and rows go together in it.
    strip = (abs(rows - 50 + 0.8 * (columns - 90)) < 12) & (abs(columns - 90) < 40)
    labels = strip.astype(np.int32)
    found = surface_statistics(labels, 1, depth_grid(cloud_of(1 / per_m), 1))
    own = labels == 1
    # A plane n . p = 1 has the inverse depth n . ray.
    plane = np.linalg.lstsq(directions[own], per_m[own], rcond=None)[0]
    np.testing.assert_allclose(found.normal[1], -plane / np.linalg.norm(plane), atol=1e-4)


def test_a_single_row_of_points_has_a_plane(cloud_of, walls):
    per_m, labels = walls
    labels[np.arange(SIZE[0]) != 20] = 0
    found = surface_statistics(labels, 3, depth_grid(cloud_of(1 / per_m), 1))
    assert np.isfinite(found.normal).all()
    np.testing.assert_allclose(np.linalg.norm(found.normal[1:], axis=1), 1.0)
