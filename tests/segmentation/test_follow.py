"""What a frame takes over from the one before: surfaces moved, labels carried, grown and settled."""

import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.follow import grown_labels, inner_places, moved_surfaces, settled_borders
from nurbseg.segmentation.inverse_depth import depth_grid, fit_window, inverse_depth_lattice
from nurbseg.segmentation.lattice import SurfaceLattice
from nurbseg.segmentation.motion import brightness, carried, flow_back
from nurbseg.segmentation.registration import PointMap
from nurbseg.segmentation.surface import NurbsSurface

SHAPE = (96, 128)
STEP = 2
CONFIG = SegmentationConfig(decimation=STEP)


def cloud_of(per_m: np.ndarray) -> PointMap:
    """A frame of a pinhole camera from its inverse depth."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = 1.0 / per_m
    points = np.dstack([(columns - 63.5) / 110 * depth, (rows - 47.5) / 110 * depth, depth])
    return PointMap(points.astype(np.float32), np.zeros((*SHAPE, 3), np.uint8), np.ones(SHAPE, np.bool_))


def wavy() -> np.ndarray:
    """Inverse depth of a smooth scene."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 0.8 + 0.001 * columns + 0.05 * np.sin(rows / 30.0)


def fitted(per_m: np.ndarray) -> NurbsSurface:
    """The surface of a whole frame."""
    grid = depth_grid(cloud_of(per_m), STEP)
    fit, _ = fit_window(grid, (0, 0, *grid.valid.shape), grid.valid, CONFIG)
    assert fit.surface is not None
    return fit.surface


@pytest.fixture(scope="module")
def surface() -> NurbsSurface:
    """Of the smooth scene."""
    return fitted(wavy())


def test_the_lattice_is_what_the_surface_is(surface: NurbsSurface) -> None:
    lattice = SurfaceLattice([None, surface], STEP)
    rows, columns = np.array([0, 5, 40, 47]), np.array([0, 63, 20, 1])
    label = np.full(4, 2, np.int32)
    u, v = np.arange(0, SHAPE[1], STEP, dtype=float), np.arange(0, SHAPE[0], STEP, dtype=float)
    exact = inverse_depth_lattice(surface, u, v)[0]
    assert lattice.at(label, rows, columns) == pytest.approx(exact[rows, columns], rel=1e-5)
    assert lattice.image(np.full(exact.shape, 2, np.int32)) == pytest.approx(exact, rel=1e-5)
    # Nothing is known of a label without a surface, nor far away.
    assert np.isinf(lattice.at(np.array([1, 0, 2]), np.array([3, 3, 500]), np.array([3, 3, 3]))).all()


def test_between_places_it_is_linear(surface: NurbsSurface) -> None:
    lattice = SurfaceLattice([surface], STEP)
    rows, columns = np.array([7, 30, 61]), np.array([9, 77, 40])
    exact, slope_u, slope_v = (
        np.array([image[0, 0] for image in values])
        for values in zip(
            *(
                inverse_depth_lattice(surface, np.array([float(c)]), np.array([float(r)]))
                for r, c in zip(rows, columns, strict=True)
            ),
            strict=True,
        )
    )
    ones = np.ones(3, np.int32)
    assert lattice.at_pixels(ones, rows, columns) == pytest.approx(exact, abs=2e-4)
    per_m, along_u, along_v = lattice.slopes_at(ones, columns.astype(float), rows.astype(float))
    assert per_m == pytest.approx(exact, abs=2e-4)
    assert along_u == pytest.approx(slope_u, abs=1e-4)
    assert along_v == pytest.approx(slope_v, abs=1e-4)


def test_surfaces_shared_with_another_lattice_are_not_evaluated_again(surface: NurbsSurface) -> None:
    first = SurfaceLattice([surface], STEP)
    second = SurfaceLattice([None, surface], STEP, first)
    assert second._images[id(surface)][3] is first._images[id(surface)][3]
    assert SurfaceLattice([surface], 1, first)._images[id(surface)][3].size > 100


def test_a_surface_follows_a_linear_change(surface: NurbsSurface) -> None:
    rows, columns = np.mgrid[: SHAPE[0] : STEP, : SHAPE[1] : STEP]
    before = SurfaceLattice([surface], STEP).image(np.ones(rows.shape, np.int32))
    now = (before + 0.01 + 1e-4 * columns - 2e-4 * rows).astype(np.float32)
    labels = np.ones(rows.shape, np.int32)
    # A thing in front of it, which has its label by mistake, does not draw it along.
    now[10:16, 10:16] += 0.5
    (moved,) = moved_surfaces(
        [surface], SurfaceLattice([surface], STEP), labels, now, inner_places(labels), STEP, 2.5e-3
    )
    found = SurfaceLattice([moved], STEP).image(labels)
    now[10:16, 10:16] -= 0.5
    # The ridge that steadies slivers holds it back by a tenth of the noise.
    assert np.abs(found - now).max() < 5e-4


def test_labels_grow_only_where_their_surface_explains() -> None:
    surface = fitted(np.full(SHAPE, 0.8))
    labels = np.ones((48, 64), np.int32)
    labels[10:30, 10:30] = 0
    per_m = np.full(labels.shape, 0.8, np.float32)
    per_m[15:25, 15:25] = 1.1
    grown = grown_labels(
        labels, labels == 0, per_m, SurfaceLattice([surface], STEP), np.array([0, 0.025], np.float32)
    )
    assert np.array_equal(grown == 0, per_m > 1)


def test_borders_go_to_the_surface_that_explains_the_pixels() -> None:
    near, far = fitted(np.full(SHAPE, 1.0)), fitted(np.full(SHAPE, 0.8))
    columns = np.arange(SHAPE[1])
    truth = np.broadcast_to(np.where(columns < 64, 1, 2), SHAPE).astype(np.uint16)
    per_m = np.where(truth == 1, 1.0, 0.8).astype(np.float32)
    labels = np.broadcast_to(np.where(columns < 61, 1, 2), SHAPE).astype(np.uint16)
    lattice = SurfaceLattice([near, far], STEP)
    for _ in range(3):
        labels = settled_borders(labels, per_m, lattice, noise_per_m=2.5e-3, gap_per_m=0.025)
    assert np.array_equal(labels, truth)


def test_values_are_carried_along_the_motion() -> None:
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(0, 255, (16, 24, 1)), np.ones((8, 8, 3))).astype(np.uint8)
    labels = np.kron(np.arange(1, 16 * 24 + 1).reshape(16, 24), np.ones((8, 8))).astype(np.uint16)
    before, now = texture[:, :180], texture[:, 4:184]
    flow = flow_back(
        brightness(np.ascontiguousarray(now), STEP), brightness(np.ascontiguousarray(before), STEP)
    )
    found = carried(np.ascontiguousarray(labels[:, :180]), flow)
    inside = np.s_[16:-16, 16:-16]
    assert np.mean(found[inside] == labels[:, 4:184][inside]) > 0.9
    # What comes into view has no label.
    assert (carried(labels, np.full((*labels.shape, 2), 1000.0, np.float32)) == 0).all()


def test_small_images_stand_still() -> None:
    tiny = np.zeros((20, 20), np.uint8)
    assert not flow_back(tiny, tiny).any()
