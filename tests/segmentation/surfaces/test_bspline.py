import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy_basis import scipy_basis

from nurbseg.segmentation.surfaces.bspline import (
    CUBIC,
    basis_matrices,
    lattice_basis,
    pixel_basis,
    pixel_knots,
)

WINDOWS = [(0, 1), (0, 40), (17, 18), (33, 97), (150, 171), (310, 500)]


def test_knots_are_those_of_the_book_worked_by_hand():
    # m + 1 = 8 parameters, 6 control points, cubic: d = 8 / 3, so i = 2, 5 and a = 2/3, 1/3.
    expected = [1 / 3 * 1 + 2 / 3 * 2, 2 / 3 * 4 + 1 / 3 * 5]
    assert_allclose(pixel_knots(8, 6), [0, 0, 0, 0, *expected, 7, 7, 7, 7])


def test_every_knot_span_holds_a_pixel():
    for size, count in ((20, 20), (39, 20), (640, 20), (7, 5)):
        held = np.histogram(np.arange(size), bins=pixel_knots(size, count)[3 : count + 1])[0]
        assert (held > 0).all(), (size, count)


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
@pytest.mark.parametrize("knots", [pixel_knots(50, 9), np.arange(-7.5, 60.0, 2.5)])
def test_the_basis_is_that_of_scipy_beyond_the_domain_too(knots: NDArray[np.float64], derivative: int):
    places = np.linspace(-3.0, 51.5, 137)
    ours = basis_matrices(knots, 3, places, 4)[derivative]
    assert_allclose(ours, scipy_basis(knots, 3, places, derivative), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("size", "count"), [(30, 7), (4, 4), (1, 4), (640, 20)])
def test_four_functions_are_not_zero_at_a_pixel(size: int, count: int):
    basis = pixel_basis(size, count)
    whole = np.zeros((size, count))
    for place in range(size):
        whole[place, basis.starts[place] : basis.starts[place] + 4] = basis.values[place]
    assert_allclose(whole, scipy_basis(pixel_knots(size, count), 3, np.arange(float(size))), atol=1e-15)


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
