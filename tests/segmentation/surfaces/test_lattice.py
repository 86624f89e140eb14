import numpy as np
from fitted import fit_of
from inverse_depth_lattice import inverse_depth_lattice

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice


def test_a_surface_is_evaluated_as_far_as_its_knots_reach(cloud_of):
    rows, columns = 2.0 * np.arange(120), 2.0 * np.arange(160)
    depth = 1.0 + 0.1 * np.sin(np.arange(320) / 9.0) + 2e-3 * np.arange(240)[:, np.newaxis]
    grid = depth_grid(cloud_of(depth), 2)
    rows_there, columns_there = np.indices(grid.shape)
    mask = (abs(rows_there - 60) < 10) & (abs(columns_there - 75) < 15)
    surface = fit_of(grid, mask, SegmentationConfig()).surface
    lattice = SurfaceLattice([None, surface], 2)
    (top, bottom), (left, right) = (knots[[3, -4]] for knots in (surface.knots_v, surface.knots_u))
    assert 0 < top < bottom < rows[-1]
    assert 0 < left < right < columns[-1]
    reached = ((rows >= top) & (rows <= bottom))[:, np.newaxis] & (columns >= left) & (columns <= right)
    expected = np.where(reached, inverse_depth_lattice(surface, columns, rows)[0], np.inf)
    found = lattice.image(np.full((120, 160), 2, dtype=np.int32))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.isinf(lattice.image(np.ones((120, 160), dtype=np.int32))).all()
