"""How well the surfaces of living leaves explain their places, against plain sums."""

from dataclasses import replace

import numpy as np
import pytest

from nurbseg.segmentation.config import ExtendedConfig, Metric, SegmentationConfig
from nurbseg.segmentation.live.leaf import LiveLeaf, misfit, update_residuals
from nurbseg.segmentation.points.grid import DepthGrid, depth_grid
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node
from nurbseg.segmentation.surfaces.curvature import principal_curvatures
from nurbseg.segmentation.surfaces.inverse_depth import fit_window
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.surfaces.noise import noise_floor, noise_floors
from nurbseg.segmentation.surfaces.surface import evaluate

SHAPE = (60, 80)
NOISE = 2.5e-3
CONFIG = SegmentationConfig(
    decimation=2, large_error_m=0.004, extended=ExtendedConfig(inverse_depth_noise=NOISE)
)


@pytest.fixture
def grid() -> DepthGrid:
    """A noisy slope with some points far off, and some missing."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    inverse_depth = 0.8 + 1e-3 * columns + NOISE * rng.standard_normal(SHAPE)
    inverse_depth[rng.random(SHAPE) < 0.1] += 0.05
    inverse_depth[50:54, 20:30] = np.nan
    depth = 1.0 / inverse_depth
    points = np.dstack([(columns - 39.5) / 70 * depth, (rows - 29.5) / 70 * depth, depth])
    return depth_grid(
        PointMap(points.astype(np.float32), np.zeros((*SHAPE, 3), np.uint8), np.ones(SHAPE, np.bool_)), 2
    )


@pytest.fixture
def labels(grid: DepthGrid) -> np.ndarray:
    """Two halves, a line that is rim all over, and nothing where there is no point."""
    labels = np.where(np.arange(40) < 20, 1, 2) * np.ones((30, 1), np.int32)
    labels[:, 30] = 3
    return (labels * grid.valid).astype(np.int32)


def leaves_of(grid: DepthGrid, labels: np.ndarray) -> list[LiveLeaf]:
    """Leaves with their surfaces; the last has one that does not reach them."""
    leaves = []
    for label in (1, 2, 3):
        mask = labels == (label if label < 3 else 1)
        mask[:, 15:20] &= label < 3
        columns = np.flatnonzero(mask.any(axis=0))
        window = (0, int(columns[0]), 30, int(columns[-1]) + 1)
        fit = fit_window(grid, window, mask[:, window[1] : window[3]], CONFIG)
        leaves.append(LiveLeaf(Node(str(label), np.flatnonzero(mask), fit)))
    return leaves


def test_misfits_are_means_over_the_inner_places_or_all_where_there_are_few(
    grid: DepthGrid, labels: np.ndarray
) -> None:
    lattice = SurfaceLattice([leaf.surface for leaf in leaves_of(grid, labels)], 2)
    found = misfit(labels, lattice, grid, NOISE, 3)
    padded = np.pad(labels, 1, mode="edge")
    inner = labels > 0
    for down in range(3):
        for across in range(3):
            inner &= padded[down : down + 30, across : across + 40] == labels
    residual = np.where(labels > 0, np.abs(lattice.image(labels) - grid.inverse_depth), 0) / NOISE
    for label in (1, 2, 3):
        own = labels == label
        assert found.counts[label] == own.sum()
        judged = np.minimum(residual[own & inner if label < 3 else own], 4.0)
        assert found.mean_squared[label] == pytest.approx(np.mean(judged**2), rel=1e-3)
        assert found.unreached[label] == pytest.approx(np.mean(np.isinf(residual[own])))
    assert found.unreached[3] == 1.0


def test_leaves_are_measured_along_the_rays(grid: DepthGrid, labels: np.ndarray) -> None:
    leaves = leaves_of(grid, labels)
    lattice = SurfaceLattice([leaf.surface for leaf in leaves], 2)
    not_reached = update_residuals(leaves, labels, lattice, grid, CONFIG)
    assert not_reached == [leaves[2]]
    points = grid.coordinates_m.reshape(3, -1).T
    for label, leaf in enumerate(leaves, start=1):
        places = np.flatnonzero(labels == label)
        assert np.array_equal(leaf.node.grid_pixels, places)
        fit = leaf.node.fit
        assert np.array_equal(fit.pixels, (places // 40 * 80 + places % 40) * 2)
        if label == 3:
            assert (fit.surface, dict(fit.values)) == (None, {})
            continue
        assert leaf.surface is not None
        on_surface = evaluate(leaf.surface, fit.pixels % 80, fit.pixels // 80)
        expected = np.linalg.norm(on_surface - points[places], axis=1)
        inverse_depth = np.abs(1 / on_surface[:, 2] - grid.inverse_depth.ravel()[places])
        assert fit.residuals_m == pytest.approx(expected, abs=1e-6)
        assert leaf.rms_per_m == pytest.approx(
            np.sqrt(np.mean(np.minimum(inverse_depth, 4 * NOISE) ** 2)), rel=1e-4
        )
        assert fit.values["mae"] == pytest.approx(expected.mean(), rel=1e-4)
        assert fit.values["mse"] == pytest.approx(np.mean(expected**2), rel=1e-4)
        assert fit.values["ve"] == pytest.approx(expected.var(), rel=1e-3)
        assert fit.values["nle"] == np.count_nonzero(fit.residuals_m > 0.004)


class Constant:
    """Surfaces that are all at one inverse depth, 1/m."""

    def __init__(self, inverse_depth: float) -> None:
        self.inverse_depth = inverse_depth

    def image(self, labels: np.ndarray) -> np.ndarray:
        return np.full(labels.shape, self.inverse_depth, dtype=np.float32)


@pytest.mark.parametrize(
    ("rows", "columns", "judged"), [(5, 5, "inside"), (4, 5, "inside"), (4, 4, "all"), (7, 2, "all")]
)
def test_the_rim_is_left_out_where_three_tenths_are_inside(
    grid: DepthGrid, rows: int, columns: int, judged: str
) -> None:
    labels = np.ones(grid.valid.shape, dtype=np.int32)
    labels[3 : 3 + rows, 3 : 3 + columns] = 2
    inverse_depth = np.full(labels.shape, 0.5, dtype=np.float32)
    inside = np.zeros(labels.shape, dtype=bool)
    inside[4 : 2 + rows, 4 : 2 + columns] = True
    # Two deviations at the rim and one inside.
    inverse_depth[labels == 2] += np.where(inside[labels == 2], 1.0, 2.0).astype(np.float32) * NOISE
    found = misfit(labels, Constant(0.5), replace(grid, inverse_depth=inverse_depth), NOISE, 2)
    expected = 1.0 if judged == "inside" else np.mean(np.where(inside[labels == 2], 1.0, 4.0))
    assert found.mean_squared[2] == pytest.approx(expected, rel=1e-3)
    assert found.counts.tolist() == [0, labels.size - rows * columns, rows * columns]
    assert found.mean_squared[0] == 0.0


def test_a_leaf_of_one_place_has_the_values_of_that_place(grid: DepthGrid, labels: np.ndarray) -> None:
    leaves = leaves_of(grid, labels)[:2]
    place = int(np.flatnonzero(labels == 2)[77])
    alone = np.where(labels == 1, 1, 0).astype(np.int32)
    alone.ravel()[place] = 2
    update_residuals(leaves, alone, SurfaceLattice([leaf.surface for leaf in leaves], 2), grid, CONFIG)
    (residual_m,) = leaves[1].node.fit.residuals_m
    assert residual_m > 0
    assert leaves[1].node.fit.values["mae"] == pytest.approx(residual_m)
    assert leaves[1].node.fit.values["mse"] == pytest.approx(residual_m**2)
    assert leaves[1].node.grid_pixels.tolist() == [place]


def test_a_fit_of_this_frame_is_kept_where_it_is_of_all_places_and_of_this_surface(
    grid: DepthGrid, labels: np.ndarray
) -> None:
    shown = np.where(labels < 3, labels, 0).astype(np.int32)

    def measured(*, age: int = 0, moved: bool = False, places: int = 0) -> bool:
        leaves = leaves_of(grid, shown)[:2]
        for label, leaf in enumerate(leaves, start=1):
            # As fitted now, to all of its places but for the first few.
            leaf.node.grid_pixels = np.flatnonzero(shown == label)[places:]
            leaf.age = age
            if moved:
                assert leaf.surface is not None
                leaf.surface = replace(leaf.surface)
        before = [leaf.node.fit for leaf in leaves]
        lattice = SurfaceLattice([leaf.surface for leaf in leaves], 2)
        assert not update_residuals(leaves, shown, lattice, grid, CONFIG)
        for label, leaf in enumerate(leaves, start=1):
            assert np.array_equal(leaf.node.grid_pixels, np.flatnonzero(shown == label))
        assert all(leaf.rms_per_m > 0 for leaf in leaves)
        kept = {leaf.node.fit is fit for leaf, fit in zip(leaves, before, strict=True)}
        assert len(kept) == 1
        return kept.pop()

    assert measured()
    assert not measured(age=1)
    assert not measured(moved=True)
    assert not measured(places=1)


@pytest.mark.parametrize("metric", ["mse", "mae", "ve", "nle", "vmec", "nlc"])
def test_floors_are_those_of_each_leaf_alone(grid: DepthGrid, labels: np.ndarray, metric: Metric) -> None:
    config = replace(CONFIG, metric=metric, large_curvature_per_m=1.0)
    found = noise_floors(grid, labels, 4, config)
    for label in (1, 2, 3):
        own = labels == label
        rows, columns = np.nonzero(own)
        window = (int(rows.min()), int(columns.min()), int(rows.max()) + 1, int(columns.max()) + 1)
        mask = own[window[0] : window[2], window[1] : window[3]]
        assert found[label] == pytest.approx(noise_floor(grid, window, mask, config), rel=1e-9)
    assert found[1] > 0


@pytest.mark.parametrize("metric", ["vmec", "mmxc"])
def test_a_curvature_that_decides_is_that_of_the_moved_surface(
    grid: DepthGrid, labels: np.ndarray, metric: Metric
) -> None:
    config = replace(CONFIG, metric=metric)
    leaves = leaves_of(grid, labels)[:2]
    for leaf in leaves:
        assert leaf.surface is not None
        # Another curvature than that of the fit, as if the surface had moved.
        bent = leaf.surface.weights + 0.05 * np.square(np.arange(leaf.surface.weights.shape[1]) - 3.0)
        net = leaf.surface.control_points_m * (leaf.surface.weights / bent)[..., np.newaxis]
        leaf.surface = replace(leaf.surface, weights=bent, control_points_m=net)
    lattice = SurfaceLattice([leaf.surface for leaf in leaves], 2)
    update_residuals(leaves, np.where(labels < 3, labels, 0).astype(np.int32), lattice, grid, config)
    for leaf in leaves:
        fit = leaf.node.fit
        assert leaf.surface is not None
        k1, k2 = principal_curvatures(leaf.surface, fit.pixels % 80, fit.pixels // 80)
        expected = np.var((k1 + k2) / 2) if metric == "vmec" else np.mean(np.maximum(abs(k1), abs(k2)))
        assert fit.values[metric] == pytest.approx(expected, rel=1e-6)
