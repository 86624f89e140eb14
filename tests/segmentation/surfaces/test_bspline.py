import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy_basis import scipy_basis

from nurbseg.segmentation.surfaces.bspline import (
    CUBIC,
    basis_matrices,
    lattice,
    pixel_basis,
    pixel_knots,
)


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


@pytest.mark.parametrize("spacing", [2.5, 25.0, 39.0625])
def test_the_functions_of_a_grid_are_the_splines_of_its_knots(spacing: float):
    found = lattice((40, 97), spacing)
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    for size, spans, products in ((40, found.spans_v, found.products_v), (97, found.spans_u, found.sums_u)):
        knots = spacing * np.arange(-3, spans[-1] + 5)
        dense = scipy_basis(knots, CUBIC, np.arange(float(size)))
        four = np.take_along_axis(dense, spans[:, np.newaxis] + np.arange(4), axis=1)
        expected = np.column_stack([*(four[:, i] * four[:, j] for i, j in pairs), four])
        if products is found.sums_u:
            # What is added at a column, of its span.
            at = np.arange(size) + spans
            products = products[at + 1] - products[at]
            assert_allclose(found.functions_u, four.T, atol=1e-12)
            assert found.edges_u.tolist() == [*np.flatnonzero(np.diff(spans, prepend=-1)), size]
        assert_allclose(products, expected, atol=1e-12)
