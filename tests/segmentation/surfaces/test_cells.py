"""Many surfaces fitted at once, compared with dense systems and with fits of the same points by others."""

import numpy as np
import pytest
from fitted import fit_of, fits_of
from numpy.testing import assert_allclose
from scipy_basis import scipy_basis

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.surfaces.inverse_depth import DepthFitter

SIZE = (24, 32)
#: A pixel of this image is 20 of a 640-wide one.
CONFIG = updated(SegmentationConfig(), extended={"knot_spacing_px": 115.0, "inverse_depth_noise": 0.02})


def frame(cloud_of):
    """The grid of a noisy slope, and labels of parts, some of single pixels that meet at corners."""
    rng, (rows, columns) = np.random.default_rng(2), np.indices(SIZE)
    grid = depth_grid(cloud_of(1 / (0.8 + 0.01 * columns - 0.005 * rows + 0.02 * rng.normal(size=SIZE))), 1)
    labels = 1 + (columns > 9) + 2 * (rows + columns > 22) * (rng.random(SIZE) < 0.5)
    labels[:, 20] = 0
    return grid, labels.astype(np.int32)


# The last column is a multiple of 6.2 but for rounding.
@pytest.mark.parametrize("spacing", [5.75, 6.2])
def test_every_surface_solves_the_penalized_normal_equations_of_its_points(cloud_of, spacing):
    grid, labels = frame(cloud_of)
    config = updated(CONFIG, extended={"knot_spacing_px": 20.0 * spacing})
    weight = CONFIG.extended.smoothness * (2 * SIZE[1] / 640) ** 2
    for label, fit in enumerate(fits_of(grid, labels, config), start=1):
        at = np.nonzero(labels == label)
        knots = fit.surface.knots_v, fit.surface.knots_u
        assert all(np.rint(each / spacing) * spacing == pytest.approx(each, abs=1e-9) for each in knots)
        Bv, Bu = (scipy_basis(each, 3, places.astype(float)) for each, places in zip(knots, at, strict=True))
        nv, nu = fit.surface.weights.shape
        A = np.einsum("na,nb->nab", Bv, Bu).reshape(-1, nv * nu)
        bends = [np.diff(np.eye(count), n=2, axis=0) for count in (nv, nu)]
        penalty = [np.kron(np.eye(nv), bends[1]), np.kron(bends[0], np.eye(nu))]
        stacked = np.concatenate([A, *(np.sqrt(weight) * each for each in penalty)])
        right = np.concatenate([grid.inverse_depth[at], np.zeros(len(stacked) - len(A))])
        expected = np.linalg.lstsq(stacked, right, rcond=None)[0]
        assert expected.min() > 0.1
        assert_allclose(fit.surface.weights.ravel(), expected, atol=1e-5)
        residuals = A @ expected / grid.inverse_depth[at] - 1.0
        assert_allclose(fit.values["mse"], np.mean((residuals * grid.distances_m[at] / (1 + residuals)) ** 2))


def test_a_surface_for_several_sets_is_that_of_their_points(cloud_of):
    grid, labels = frame(cloud_of)
    fitter = DepthFitter(grid, CONFIG)
    one, two, three, four = fitter.of_labels(labels, np.arange(5))
    halves = fitter.of_pixels([four[0][::2], four[0][1::2]])
    for members in ((one, three), (two, four), (one, two, three, four), (*halves, one)):
        grid_pixels, fit = fitter.of_union([fit for _, fit in members])
        expected = np.sort(np.concatenate([part for part, _ in members]))
        assert grid_pixels.tolist() == expected.tolist()
        mask = np.isin(np.arange(grid.valid.size), expected).reshape(SIZE)
        alone = fit_of(grid, mask, CONFIG)
        assert fit.surface.window == alone.surface.window
        for name in ("knots_u", "knots_v", "control_points_m"):
            assert_allclose(getattr(fit.surface, name), getattr(alone.surface, name), rtol=1e-9)
        assert_allclose(fit.residuals_m, alone.residuals_m, atol=1e-12)
        assert (fit.floor, fit.rms_per_m) == pytest.approx((alone.floor, alone.rms_per_m), rel=1e-12)
    # A union is a member of others.
    both = fitter.of_union([fitter.of_union([one[1], two[1]])[1], three[1]])
    assert both[0].tolist() == np.flatnonzero((labels > 0) & (labels < 4)).tolist()


def test_a_set_without_a_point_has_no_surface_and_moves_no_other(cloud_of):
    grid, labels = frame(cloud_of)
    number_of = np.array([0, 0, 1, 3, 3])
    (_, first), (nothing, none), (pixels, last) = DepthFitter(grid, CONFIG).of_labels(labels, number_of)
    assert (nothing.size, none.surface, none.reason) == (0, None, "0 points, 1 needed")
    assert first.surface.weights.tolist() == fit_of(grid, labels == 2, CONFIG).surface.weights.tolist()
    assert pixels.tolist() == np.flatnonzero(labels >= 3).tolist() == last.pixels.tolist()
