import numpy as np
import pytest
from fitted import fits_of
from inverse_depth_lattice import inverse_depth_lattice

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.extended.refitting import refit_surfaces
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.surfaces.inverse_depth import DepthFitter

# Stiff surfaces bend far beyond a strip.
CONFIG = SegmentationConfig(extended=ExtendedConfig(knot_spacing_px=50.0, smoothness=1.0))
#: First row of the image that sees the floor before the wall.
EDGE = 240


@pytest.fixture
def concave_corner(cloud_of, request):
    """Return the grid of a wall above a floor with some noise, and the inverse depth of the floor."""
    rows = np.mgrid[:480, :320][0]
    floor = 1.0 + 8e-3 * (rows - EDGE)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(floor.shape)
    depth = 1.0 / (np.maximum(1.0, floor) + noise)
    depth[EDGE + request.param :] = np.nan
    return depth_grid(cloud_of(depth), 2), floor


def parted_at(grid, row):
    rows = np.arange(grid.valid.shape[0])[:, np.newaxis]
    return (np.where(rows < row, 1, 2) * grid.valid).astype(np.int32)


# So small a floor changes much.
@pytest.mark.parametrize("concave_corner", [30], indirect=True)
def test_a_surface_bent_by_a_strip_of_its_neighbor_is_fitted_again(concave_corner):
    grid, floor = concave_corner
    truth, cut = (parted_at(grid, EDGE // 2 - strip) for strip in (0, 3))
    fits = fits_of(grid, cut, CONFIG)
    labels, surfaces, rms_per_m = refit_surfaces(cut, fits, DepthFitter(grid, CONFIG), CONFIG)
    assert (labels != truth).sum() < 0.5 * (cut != truth).sum()
    rows, columns = np.arange(EDGE - 10.0, EDGE + 10.0), np.arange(20.0, 300.0)
    before, after = (
        np.abs(inverse_depth_lattice(each, columns, rows)[0] - floor[EDGE - 10 : EDGE + 10, 20:300]).mean()
        for each in (fits[1].surface, surfaces[1])
    )
    assert after < 0.5 * before
    # It is the surface of the new labels; that of the wall, which lost little, is the one that it had.
    again = fits_of(grid, labels, CONFIG)[1]
    assert np.array_equal(surfaces[1].weights, again.surface.weights)
    assert surfaces[0] is fits[0].surface
    assert rms_per_m == [fits[0].rms_per_m, again.rms_per_m]
    # The same with the other numbers.
    swap = np.array([0, 2, 1], dtype=np.int32)
    swapped, _, swapped_rms_per_m = refit_surfaces(swap[cut], fits[::-1], DepthFitter(grid, CONFIG), CONFIG)
    assert np.array_equal(swapped, swap[labels])
    assert swapped_rms_per_m == rms_per_m[::-1]


@pytest.mark.parametrize("concave_corner", [220], indirect=True)
def test_borders_that_hardly_move_leave_the_fits_as_they_are(concave_corner):
    grid, _ = concave_corner
    cut = parted_at(grid, EDGE // 2 - 1)
    fits = fits_of(grid, cut, CONFIG)
    labels, surfaces, _ = refit_surfaces(cut, fits, DepthFitter(grid, CONFIG), CONFIG)
    assert (labels != cut).any()
    assert all(surface is fit.surface for surface, fit in zip(surfaces, fits, strict=True))
