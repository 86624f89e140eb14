"""What a frame takes over from the one before: surfaces moved, labels warped and grown."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from fitted import fit_of

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.follow import follow_labels
from nurbseg.segmentation.live.motion import flow_back, warped
from nurbseg.segmentation.points.grid import DepthGrid, depth_grid
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

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


def grid_of(inverse_depth: np.ndarray) -> DepthGrid:
    """The grid of a frame, with inverse depths of its grid pixels."""
    grid = depth_grid(cloud_of(wavy()), STEP)
    return replace(grid, inverse_depth=inverse_depth.astype(np.float32), valid=inverse_depth > 0)


def on_pixels(labels: np.ndarray) -> np.ndarray:
    """Labels of every pixel from those on the grid."""
    return np.kron(labels, np.ones((STEP, STEP))).astype(np.uint16)


def values(surface: NurbsSurface) -> np.ndarray:
    """Inverse depth of a surface on the grid."""
    rows, columns = np.indices((SHAPE[0] // STEP, SHAPE[1] // STEP), np.int32)
    found = SurfaceTable([surface]).inverse_depths(
        np.ones(rows.size, np.int32), STEP * rows.ravel(), STEP * columns.ravel()
    )
    return found.reshape(rows.shape)


@pytest.mark.parametrize("noise_per_m", [2.5e-3, 2.5e-4])
def test_the_change_is_that_of_least_squares(surface: NurbsSurface, noise_per_m: float) -> None:
    rng = np.random.default_rng(3)
    rows, columns = np.indices((SHAPE[0] // STEP, SHAPE[1] // STEP))
    labels = np.ones(rows.shape, np.int32)
    # Between two parts of the other label.
    labels[:, 24:44], labels[20:24, 10:14] = 2, 0
    now = values(surface) + 0.01 * labels + 2e-4 * columns
    now += 2e-3 * rng.standard_normal(rows.shape)
    found = follow_labels(
        on_pixels(labels), SurfaceTable([surface, surface]), [0.0, 0.0], grid_of(now), noise_per_m, 8.0
    )
    for label in (1, 2):
        # Away from other labels, whose places tell nothing.
        inner = cv2.erode((labels == label).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        change = (now.astype(np.float32) - values(surface))[inner]
        # Those that agree with the mean: all, or within two deviations where these are more than the noise.
        near = np.abs(change - change.mean()) < max(6.0 * noise_per_m, 2.0 * change.std())
        assert near.all() == (noise_per_m == 2.5e-3)
        along = np.column_stack([columns[inner], rows[inner]])
        center, level = along[near].mean(axis=0), change[near].mean()
        around = along[near] - center
        # The ridge is one grid pixel more in each direction, and four for each.
        ridge = np.vstack([around, np.sqrt(4.0 * len(around) + 1.0) * np.eye(2)])
        slopes = np.linalg.lstsq(ridge, np.append(change[near] - level, [0.0, 0.0]), rcond=None)[0]
        expected = level + (along - center) @ slopes
        constant, along_u, along_v = found.planes[label]
        assert constant + along @ [along_u, along_v] == pytest.approx(expected, abs=1e-6)


def test_points_keep_a_label_that_explains_them_unless_the_scene_is_new(surface: NurbsSurface) -> None:
    labels = np.ones((SHAPE[0] // STEP, SHAPE[1] // STEP), np.int32)
    labels[30:34, 30:40] = 0
    for height, is_same in ((3, True), (10, False)):
        now = values(surface)
        # In front of it, by more than it can have moved; where there is no point; and as before.
        now[:height], now[40] = 0.5, 0.0
        found = follow_labels(on_pixels(labels), SurfaceTable([surface]), [0.0], grid_of(now), 2.5e-3, 8.0)
        expected = np.where((now == 0.5) | (now == 0.0), 0, 1 if is_same else labels)
        assert np.array_equal(found.labels, expected)
        assert found.is_same_scene == is_same
        assert found.unexplained == pytest.approx(height * 64 / np.count_nonzero(labels[now > 0]))


def test_a_label_that_is_hardly_shown_vanishes(surface: NurbsSurface) -> None:
    labels = np.ones((SHAPE[0] // STEP, SHAPE[1] // STEP), np.int32)
    for shown in (1, 2):
        labels[5, 5 : 5 + shown] = 2
        surfaces, grid = SurfaceTable([surface, surface]), grid_of(values(surface))
        found = follow_labels(on_pixels(labels), surfaces, [0.0, 0.0], grid, 2.5e-3, 8.0)
        assert np.count_nonzero(found.labels == 2) == (0 if shown < 2 else 2)
        assert np.count_nonzero(found.labels) == labels.size


def test_labels_grow_to_the_neighbor_that_explains_best() -> None:
    rng = np.random.default_rng(8)
    deviations, levels = (0.0004, 0.0006, 0.0003), np.array([1.0, 1.003, 0.994], np.float32)
    surfaces = SurfaceTable([fitted(np.full(SHAPE, level)) for level in levels])
    shape = SHAPE[0] // STEP, SHAPE[1] // STEP
    labels = rng.integers(1, 4, shape).astype(np.int32)
    labels[rng.random(shape) < 0.1] = 0
    labels[10:20, 10:40] = 0
    now = np.where(labels > 0, levels[labels - 1], 1.0 + 0.004 * rng.standard_normal(shape)).astype(
        np.float32
    )
    now[rng.random(shape) < 0.05] = 0.0
    # What touches only the other end of a row or column is no neighbor.
    labels[:, :3], labels[:, -1] = 0, 3
    now[:, -1] = levels[2]
    labels[now == 0] = 0
    expected = labels.copy()
    height, width = shape
    for _ in range(12):
        before = expected.copy()
        for r, c in np.argwhere((before == 0) & (now > 0)):
            beside = [(r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)]
            around = {
                int(before[at]) for at in beside if min(at) >= 0 and at[0] < height and at[1] < width
            } - {0}
            fits = {each: abs(levels[each - 1] - now[r, c]) for each in around}
            fits = {each: off for each, off in fits.items() if off < 10 * deviations[each - 1]}
            expected[r, c] = min(fits, key=lambda fit: fits[fit], default=0)
    assert 100 < np.count_nonzero(expected != labels) < np.count_nonzero((labels == 0) & (now > 0))
    found = follow_labels(on_pixels(labels), surfaces, deviations, grid_of(now), 1e-6, 8.0)
    assert np.array_equal(found.labels, expected)


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
