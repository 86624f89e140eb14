import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy_basis import scipy_basis

from nurbseg.segmentation.surfaces.bspline import averaged_knots, basis_matrix, pixel_basis, pixel_knots


def test_knots_are_those_of_the_book_worked_by_hand():
    # m + 1 = 8 parameters, 6 control points, cubic: d = 8 / 3, so i = 2, 5 and a = 2/3, 1/3.
    parameters = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 7.0, 8.0, 9.0])
    expected = [1 / 3 * 1 + 2 / 3 * 2, 2 / 3 * 5 + 1 / 3 * 7]
    assert_allclose(averaged_knots(parameters, 6), [0, 0, 0, 0, *expected, 9, 9, 9, 9])


def test_every_knot_span_holds_a_parameter():
    for size, count in ((20, 20), (39, 20), (640, 20), (7, 5)):
        pixels = np.arange(size, dtype=float)
        spans = averaged_knots(pixels, count)[3 : count + 1]
        held = np.histogram(pixels, bins=spans)[0]
        assert (held > 0).all(), (size, count)


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
@pytest.mark.parametrize("knots", [averaged_knots(np.arange(50.0), 9), np.arange(-7.5, 60.0, 2.5)])
def test_the_basis_is_that_of_scipy_beyond_the_domain_too(knots: NDArray[np.float64], derivative: int):
    places = np.linspace(-3.0, 51.5, 137)
    ours = basis_matrix(knots, 3, places, derivative)
    assert_allclose(ours, scipy_basis(knots, 3, places, derivative), rtol=1e-9, atol=1e-12)


def test_a_single_pixel_has_a_basis_that_sums_to_one():
    assert_allclose(pixel_basis(1, 4).values.sum(axis=1), 1.0)


@pytest.mark.parametrize(("size", "count"), [(30, 7), (4, 4), (1, 4), (640, 20)])
def test_four_functions_are_not_zero_at_a_pixel(size: int, count: int):
    basis = pixel_basis(size, count)
    whole = np.zeros((size, count))
    for place in range(size):
        whole[place, basis.starts[place] : basis.starts[place] + 4] = basis.values[place]
    assert_allclose(whole, scipy_basis(pixel_knots(size, count), 3, np.arange(float(size))), atol=1e-15)


def test_fewer_control_points_than_a_cubic_needs_are_refused():
    with pytest.raises(ValueError, match="at least 4 control points, got 3"):
        averaged_knots(np.arange(9.0), 3)
    with pytest.raises(ValueError, match="got none"):
        averaged_knots(np.zeros(0), 4)
