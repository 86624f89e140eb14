import numpy as np
import pytest
from exact_surface import derivatives
from numpy.testing import assert_allclose

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.grid import decimated_grid
from nurbseg.segmentation.surfaces.fit import control_point_count, fit_on_grid, fit_surface
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate, normals

ROOT = np.sqrt(0.5)


def quarter_cylinder(radius: float = 0.25, length: float = 2.0) -> NurbsSurface:
    """The exact rational quarter circle, swept along z."""
    arc = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * radius
    control = np.zeros((2, 3, 3))
    control[..., :2] = arc
    control[1, :, 2] = length
    weights = np.tile([1.0, ROOT, 1.0], (2, 1))
    return NurbsSurface(
        (2, 1), np.array([0.0, 0, 0, 1, 1, 1]), np.array([0.0, 0, 1, 1]), control, weights, (0, 0, 2, 2)
    )


def wavy_rational() -> NurbsSurface:
    rng = np.random.default_rng(0)
    knots = np.array([0.0, 0, 0, 0, 4, 10, 10, 10, 10])
    return NurbsSurface(
        (3, 3), knots, knots, rng.normal(size=(5, 5, 3)), rng.uniform(0.5, 2.0, (5, 5)), (0, 0, 11, 11)
    )


ORDERS = {"": (0, 0), "u": (1, 0), "v": (0, 1), "uu": (2, 0), "uv": (1, 1), "vv": (0, 2)}


@pytest.mark.parametrize("name", ORDERS)
@pytest.mark.parametrize("surface", [wavy_rational(), quarter_cylinder()], ids=["wavy", "cylinder"])
def test_points_and_derivatives_are_those_of_scipy_scattered_and_on_a_lattice(surface, name):
    u, v = (np.linspace(0.01, 0.99, n) * surface.knots_u[-1] for n in (17, 11))
    columns, rows = np.meshgrid(u, v)
    expected = derivatives(surface, columns.ravel(), rows.ravel())[name]
    assert_allclose(
        evaluate(surface, columns.ravel(), rows.ravel(), *ORDERS[name]), expected, atol=1e-9, rtol=1e-9
    )
    lattice = evaluate(surface, u, v[:, np.newaxis], *ORDERS[name])
    assert_allclose(lattice.reshape(-1, 3), expected, atol=1e-9, rtol=1e-9)


def test_a_rational_quarter_circle_is_exact_and_its_normals_are_radial():
    u = np.linspace(0, 1, 41)
    points, found = (function(quarter_cylinder(), u, u) for function in (evaluate, normals))
    assert_allclose(np.hypot(points[:, 0], points[:, 1]), 0.25, atol=1e-14)
    assert_allclose(points[:, 2], np.linspace(0, 2, 41), atol=1e-14)
    assert_allclose((found * points)[:, :2].sum(axis=1), 0.25, atol=1e-12)


def test_points_of_many_parameters_are_those_of_each():
    surface = wavy_rational()
    u, v = np.random.default_rng(2).uniform(0, 10, (2, 40_000))
    many = evaluate(surface, u, v)
    # The derivatives, which were computed with them, are not kept.
    assert many.base is None
    for n in (0, 32_767, 32_768, 39_999):
        assert_allclose(many[n], evaluate(surface, u[n], v[n]), atol=1e-12)


def test_third_derivatives_and_unequal_parameters_are_refused():
    with pytest.raises(ValueError, match="orders of 0 to 2"):
        evaluate(wavy_rational(), np.zeros(1), np.zeros(1), 2, 1)
    with pytest.raises(ValueError, match="broadcast"):
        evaluate(wavy_rational(), np.zeros(2), np.zeros(3))


def test_a_surface_says_which_of_its_arrays_does_not_match():
    good = wavy_rational()
    with pytest.raises(ValueError, match="knots_v"):
        NurbsSurface((3, 3), good.knots_u, good.knots_v[1:], good.control_points_m, good.weights, good.window)
    with pytest.raises(ValueError, match="weights"):
        NurbsSurface((3, 3), good.knots_u, good.knots_v, good.control_points_m, 0 * good.weights, good.window)


def test_control_points_are_in_proportion_to_the_extent():
    config = SegmentationConfig()
    assert control_point_count(640, 640, config) == 20
    assert control_point_count(320, 640, config) == 10
    assert control_point_count(30, 640, config) == 4
    assert control_point_count(1, 640, config) == 4


def test_a_fit_has_its_parameters_in_pixels_of_the_full_image(cloud_of):
    rows, columns = np.mgrid[:60, :80]
    cloud = cloud_of(1.0 + 0.002 * rows + 1e-5 * (columns - 40.0) ** 2)
    mask = np.zeros((60, 80), dtype=bool)
    mask[12:52, 7:71] = np.hypot(rows - 30, columns - 40)[12:52, 7:71] < 30
    pixels = np.flatnonzero(mask)
    fit = fit_surface(cloud, pixels, SegmentationConfig())
    assert fit.surface is not None
    assert fit.surface.window == (12, 11, 52, 70)
    assert (fit.surface.knots_u[0], fit.surface.knots_u[-1]) == (11, 69)
    assert (fit.surface.knots_v[0], fit.surface.knots_v[-1]) == (12, 51)
    found = evaluate(fit.surface, pixels % 80, pixels // 80)
    points = cloud.points_m.reshape(-1, 3)[pixels]
    assert_allclose(np.linalg.norm(found - points, axis=1), fit.residuals_m, atol=1e-9)
    assert fit.residuals_m.max() < 1e-5
    assert fit.reason == ""


def test_a_fit_on_a_coarser_grid_has_the_same_parameters(cloud_of):
    rows, columns = np.mgrid[:60, :80]
    cloud = cloud_of(1.0 + 0.002 * rows + 1e-5 * (columns - 40.0) ** 2)
    grid = decimated_grid(cloud, 3)
    mask = np.zeros(grid.shape, dtype=bool)
    mask[4:17, 2:23] = True
    fit = fit_on_grid(grid, np.flatnonzero(mask), SegmentationConfig())
    assert fit.surface is not None
    found = evaluate(fit.surface, fit.pixels % 80, fit.pixels // 80)
    assert_allclose(found, cloud.points_m.reshape(-1, 3)[fit.pixels], atol=1e-4)
    assert (fit.pixels[0], fit.pixels[-1]) == (12 * 80 + 6, 48 * 80 + 66)


def test_nothing_to_fit_is_a_result_with_a_reason(cloud_of):
    cloud = cloud_of(np.ones((8, 8)))
    fit = fit_surface(cloud, np.zeros(0, dtype=np.intp), SegmentationConfig())
    assert fit.surface is None
    assert fit.reason == "0 points, 1 needed"


def test_fitting_a_pixel_without_a_point_is_refused(cloud_of):
    depth = np.ones((8, 8))
    depth[2, 2] = np.nan
    with pytest.raises(ValueError, match="have a point"):
        fit_surface(cloud_of(depth), np.array([18]), SegmentationConfig())


@pytest.mark.parametrize("pixels", [[5], [5, 6, 7], [5, 13, 21]])
def test_a_few_pixels_in_a_row_have_a_surface_through_them(cloud_of, pixels):
    rows, columns = np.mgrid[:8, :8]
    cloud = cloud_of(1 + 0.1 * rows + 0.05 * columns)
    fit = fit_surface(cloud, np.array(pixels), SegmentationConfig())
    assert fit.surface is not None
    assert fit.residuals_m.max() < 1e-5
