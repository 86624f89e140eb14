"""What a frame takes over from the one before: surfaces moved, labels warped and grown."""

import cv2
import numpy as np
import pytest
from fitted import fit_of

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.follow import grown_labels, moved_lattice
from nurbseg.segmentation.live.motion import flow_back, warped
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.surfaces.surface import NurbsSurface

SHAPE = (96, 128)
STEP = 2
CONFIG = SegmentationConfig(decimation=STEP)


def cloud_of(inverse_depth: np.ndarray) -> PointMap:
    """A frame of a pinhole camera from its inverse depth."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = 1.0 / inverse_depth
    points = np.dstack([(columns - 63.5) / 110 * depth, (rows - 47.5) / 110 * depth, depth])
    return PointMap(points.astype(np.float32), np.zeros((*SHAPE, 3), np.uint8), np.ones(SHAPE, np.bool_))


def wavy() -> np.ndarray:
    """Inverse depth of a smooth surface."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 0.8 + 0.001 * columns + 0.05 * np.sin(rows / 30.0)


def fitted(inverse_depth: np.ndarray) -> NurbsSurface:
    """The surface of a whole frame."""
    grid = depth_grid(cloud_of(inverse_depth), STEP)
    fit = fit_of(grid, grid.valid, CONFIG)
    assert fit.surface is not None
    return fit.surface


@pytest.fixture(scope="module")
def surface() -> NurbsSurface:
    """Of the smooth inverse depth."""
    return fitted(wavy())


@pytest.mark.parametrize("noise_per_m", [2.5e-3, 2.5e-4])
def test_the_change_is_that_of_least_squares(surface: NurbsSurface, noise_per_m: float) -> None:
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[: SHAPE[0] : STEP, : SHAPE[1] : STEP]
    labels = np.ones(rows.shape, np.int32)
    # Between two parts of the other label.
    labels[:, 24:44], labels[20:24, 10:14] = 2, 0
    lattice = SurfaceLattice([surface, surface], STEP)
    now = lattice.image(np.ones(rows.shape, np.int32)) + 0.01 * labels + 1e-4 * columns
    now += 2e-3 * rng.standard_normal(rows.shape)
    found = moved_lattice(lattice, labels, now.astype(np.float32), noise_per_m)
    for label in (1, 2):
        own = np.full(rows.shape, label, np.int32)
        # Away from other labels, whose places tell nothing.
        inner = cv2.erode((labels == label).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        change = (now - lattice.image(own))[inner]
        # Those that agree with the mean: all, or within two deviations where these are more than the noise.
        near = np.abs(change - change.mean()) < max(6.0 * noise_per_m, 2.0 * change.std())
        assert near.all() == (noise_per_m == 2.5e-3)
        along = np.column_stack([columns[inner], rows[inner]]) / STEP
        center, level = along[near].mean(axis=0), change[near].mean()
        around = along[near] - center
        # The ridge is one grid pixel more in each direction, and four for each.
        ridge = np.vstack([around, np.sqrt(4.0 * len(around) + 1.0) * np.eye(2)])
        slopes = np.linalg.lstsq(ridge, np.append(change[near] - level, [0.0, 0.0]), rcond=None)[0]
        fitted = level + (along - center) @ slopes
        assert (found.image(own) - lattice.image(own))[inner] == pytest.approx(fitted, abs=1e-6)


def test_labels_grow_to_the_neighbor_that_explains_best() -> None:
    rng = np.random.default_rng(8)
    limits, values = (0.004, 0.006, 0.003), (1.0, 1.003, 0.994)
    lattice = SurfaceLattice([fitted(np.full(SHAPE, value)) for value in values], STEP)
    depths = (1.0 + 0.004 * rng.standard_normal((20, 24))).astype(np.float32)
    depths[rng.random(depths.shape) < 0.05] = 0.0
    labels = (rng.integers(1, 4, depths.shape) * (rng.random(depths.shape) < 0.05)).astype(np.int32)
    # What touches only the other end of a row or column is no neighbor.
    labels[:3], labels[:, :3], labels[-1], labels[:, -1] = 0, 0, 2, 3
    expected = labels.copy()
    for _ in range(12):
        before = expected.copy()
        for r, c in np.argwhere((before == 0) & (depths > 0)):
            beside = [(r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)]
            around = {int(before[at]) for at in beside if min(at) >= 0 and at[0] < 20 and at[1] < 24} - {0}
            fits = {each: abs(values[each - 1] - depths[r, c]) for each in around}
            fits = {each: residual for each, residual in fits.items() if residual < limits[each - 1]}
            expected[r, c] = min(fits, key=lambda fit: fits[fit], default=0)
    assert 100 < np.count_nonzero(expected != labels) < np.count_nonzero((labels == 0) & (depths > 0))
    found = grown_labels(labels, depths, lattice, np.array([0.0, *limits], np.float32))
    assert np.array_equal(found, expected)


def test_values_come_from_the_pixel_nearest_to_where_the_flow_points() -> None:
    rng = np.random.default_rng(7)
    image = rng.integers(1, 60000, (50, 70)).astype(np.uint16)
    flow = cv2.GaussianBlur(rng.normal(0, 40, (25, 35, 2)).astype(np.float32), (0, 0), 4)
    wide = 2 * cv2.resize(flow, (70, 50), interpolation=cv2.INTER_LINEAR)
    rows, columns = np.mgrid[:50, :70]
    v, u = (np.rint(at + wide[..., axis]).astype(int) for axis, at in ((1, rows), (0, columns)))
    inside = (v >= 0) & (v < 50) & (u >= 0) & (u < 70)
    expected = np.where(inside, image[v.clip(0, 49), u.clip(0, 69)], 0)
    # Between two pixels either is the nearest.
    assert np.mean(warped(image, flow) == expected) > 0.998


def test_small_images_stand_still() -> None:
    texture = np.kron(np.random.default_rng(0).integers(0, 255, (8, 12)), np.ones((4, 4))).astype(np.uint8)
    for height, moves in ((32, True), (31, False)):
        now, before = texture[:height, 2:], texture[:height, :-2]
        assert flow_back(np.ascontiguousarray(now), np.ascontiguousarray(before)).any() == moves
