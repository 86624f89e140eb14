import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy_basis import scipy_basis

from nurbseg.segmentation.surfaces.bspline import CUBIC
from nurbseg.segmentation.surfaces.knot_lattice import lattice_basis

WINDOWS = [(0, 1), (0, 40), (17, 18), (33, 97), (150, 171), (310, 500)]


@pytest.mark.parametrize(("start", "stop"), WINDOWS)
@pytest.mark.parametrize("margin", [1, 12])
@pytest.mark.parametrize("spacing", [2.5, 25.0, 39.0625])
def test_the_functions_are_the_splines_of_their_knots(start, stop, margin, spacing):
    basis, knots = lattice_basis(start, stop, margin, spacing)
    assert knots.size == basis.size + CUBIC + 1
    dense = np.zeros((stop - start, basis.size))
    np.put_along_axis(dense, basis.starts[:, np.newaxis] + np.arange(CUBIC + 1), basis.values, axis=1)
    places = np.arange(start, stop, dtype=np.float64)
    assert_allclose(dense, scipy_basis(knots, CUBIC, places), atol=1e-12)


@pytest.mark.parametrize(("start", "stop"), WINDOWS)
@pytest.mark.parametrize("margin", [1, 12])
def test_the_knots_reach_a_margin_beyond_the_window(start, stop, margin):
    _, knots = lattice_basis(start, stop, margin, 25.0)
    first, last = knots[CUBIC], knots[-CUBIC - 1]
    assert first <= start - margin
    assert last >= stop - 1 + margin
    # And no function more than that takes.
    assert first > start - margin - 25.0
    assert last <= stop - 1 + margin + 25.0


def test_windows_share_their_knots():
    one, other = lattice_basis(10, 60, 5, 25.0)[1], lattice_basis(33, 300, 5, 25.0)[1]
    assert_allclose(np.intersect1d(one, other), one[one >= other[0]])
