import numpy as np
import pytest
from exact_surface import principal_curvatures as exact_curvatures
from numpy.testing import assert_allclose

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.curvature import all_metrics, principal_curvatures
from nurbseg.segmentation.surfaces.fit import fit_surface
from nurbseg.segmentation.surfaces.metrics import METRICS
from nurbseg.segmentation.surfaces.surface import NurbsSurface


def graph_cloud(height_of, size: int = 81, half_m: float = 0.1) -> PointMap:
    """Points (x, y, f(x, y)) + 1 m in front of the camera, on a regular grid of x and y."""
    axis = np.linspace(-half_m, half_m, size)
    x, y = np.meshgrid(axis, axis)
    points = np.stack([x, y, 1.0 + height_of(x, y)], axis=-1).astype(np.float32)
    return PointMap(points, np.zeros((size, size, 3), dtype=np.uint8), np.ones((size, size), dtype=bool))


def interior(size: int = 81) -> np.ndarray:
    rows, columns = np.mgrid[10 : size - 10, 10 : size - 10]
    return (rows * size + columns).ravel()


@pytest.mark.parametrize(
    ("height_of", "larger", "smaller"),
    [
        pytest.param(lambda x, y: 0.3 - np.sqrt(0.09 - x**2 - y**2), 1 / 0.3, 1 / 0.3, id="sphere"),
        pytest.param(lambda x, y: 0.2 - np.sqrt(0.04 - x**2), 5.0, 0.0, id="cylinder"),
        pytest.param(lambda x, y: 2.0 * (x**2 - y**2), 4.0, 4.0, id="saddle"),
    ],
)
def test_fitted_surfaces_have_the_curvatures_of_their_shape(height_of, larger, smaller):
    fit = fit_surface(graph_cloud(height_of), np.arange(81 * 81), SegmentationConfig())
    assert fit.surface is not None
    # The saddle has them in its middle alone.
    at = interior() if larger != 4.0 else np.array([40 * 81 + 40])
    found = np.sort(np.abs(principal_curvatures(fit.surface, at % 81, at // 81)), axis=0)
    assert_allclose(found[1], larger, rtol=0.01)
    assert_allclose(found[0], smaller, rtol=0.01, atol=0.02)


def test_curvatures_are_the_eigenvalues_of_the_shape_operator():
    """Of a rational surface with nothing regular about it, by SciPy's splines."""
    rng = np.random.default_rng(0)
    knots = np.array([0.0, 0, 0, 0, 3, 8, 8, 8, 8])
    rows, columns = np.mgrid[:5, :5]
    control = np.stack([columns, rows + 0.3 * columns, np.zeros((5, 5))], axis=-1) * 0.1
    control += 0.02 * rng.normal(size=(5, 5, 3))
    surface = NurbsSurface((3, 3), knots, knots, control, rng.uniform(0.5, 2.0, (5, 5)), (0, 0, 9, 9))
    pixels = np.arange(81)
    exact = exact_curvatures(surface, pixels % 9, pixels // 9)
    assert np.abs(exact).max() > 5.0
    assert_allclose(principal_curvatures(surface, pixels % 9, pixels // 9), exact, rtol=1e-6, atol=1e-6)
    # Also on a lattice, and at a single point.
    on_lattice = np.stack(principal_curvatures(surface, np.arange(9), np.arange(9)[:, np.newaxis]))
    assert on_lattice.shape == (2, 9, 9)
    assert_allclose(on_lattice.reshape(2, 81), exact, rtol=1e-6, atol=1e-6)
    assert_allclose(principal_curvatures(surface, 4.0, 2.0), np.array(exact)[:, 22], rtol=1e-6)


@pytest.mark.parametrize("along", [0.0, 1.0], ids=["a point", "a line"])
def test_a_surface_without_a_tangent_plane_has_no_curvature(along):
    knots = np.array([0.0, 0, 0, 0, 1, 1, 1, 1])
    rows, columns = np.mgrid[:4, :4]
    control = np.ones((4, 4, 3)) + along * (rows + 2.0 * columns**2)[..., None] * np.array([0.1, 0.3, 0.2])
    surface = NurbsSurface((3, 3), knots, knots, control, np.ones((4, 4)), (0, 0, 2, 2))
    k1, k2 = principal_curvatures(surface, np.array([0.5]), np.array([0.5]))
    assert np.isnan(k1).all()
    assert np.isnan(k2).all()


def test_all_nine_metrics_of_a_sphere():
    cloud = graph_cloud(lambda x, y: 0.05 - np.sqrt(0.0025 - np.minimum(x**2 + y**2, 0.001)), half_m=0.02)
    fit = fit_surface(cloud, interior(), SegmentationConfig())
    values = all_metrics(fit, 81, SegmentationConfig(large_curvature_per_m=15.0))
    assert tuple(values) == METRICS
    assert values["mmxc"] == pytest.approx(20.0, rel=0.03)
    assert values["nlc"] == interior().size
    assert values["vmxc"] < 1.0
