import numpy as np
import pytest
from numpy.testing import assert_allclose

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import features, lab, normalization, normalized


def exact_lab(rgb):
    """CIELab by its definition (IEC 61966-2-1, D65), in double precision."""
    c = np.asarray(rgb, dtype=float) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_xyz = [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
    xyz = linear @ np.array(to_xyz).T / [0.950456, 1.0, 1.088754]
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def test_lab_follows_its_definition():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (500, 3)).astype(np.uint8)
    assert_allclose(lab(rgb), exact_lab(rgb), atol=0.01)
    assert_allclose(lab(np.array([[255, 255, 255], [0, 0, 0]], dtype=np.uint8))[:, 0], [100, 0], atol=0.01)


def test_vectors_follow_equation_3(cloud_of):
    rng = np.random.default_rng(1)
    depth = rng.uniform(1, 2, (20, 30))
    depth[3, 4] = np.nan
    cloud = cloud_of(depth, rng.integers(0, 256, (20, 30, 3)))
    vectors = features(cloud, SegmentationConfig(geometry_weight=2.5))
    assert vectors.shape == (599, 6)
    assert vectors.dtype == np.float32
    color = exact_lab(cloud.color[cloud.valid])
    points = cloud.points_m[cloud.valid].astype(float)
    expected = np.hstack([color / color.std(axis=0).mean(), 2.5 * points / points.std(axis=0).mean()])
    expected -= expected.mean(axis=0)
    assert_allclose(vectors, expected, atol=0.01)


def test_a_constant_color_gives_zeros_and_not_its_rounding(cloud_of):
    cloud = cloud_of(np.random.default_rng(2).uniform(1, 2, (40, 40)), (17, 200, 83))
    vectors = features(cloud, SegmentationConfig())
    assert (vectors[:, :3] == 0).all()
    assert vectors[:, 3:].std() > 0.5


def test_no_points_have_no_vectors(cloud_of):
    assert features(cloud_of(np.full((4, 5), np.nan)), SegmentationConfig()).shape == (0, 6)


@pytest.mark.parametrize("columns", [6, 9])
def test_each_triple_has_its_mean_deviation_and_weight(columns):
    rng = np.random.default_rng(4)
    raw = (rng.normal(size=(50, columns)) * rng.uniform(0.1, 9.0, columns) + 5.0).astype(np.float32)
    scale = normalization(raw, 2.0, color_weight=0.25, normal_weight=3.0)
    exact = raw.astype(float)
    sigma = exact.std(axis=0).reshape(-1, 3).mean(axis=1)
    assert_allclose(scale.mean, exact.mean(axis=0), rtol=1e-6)
    assert_allclose(scale.factor, np.repeat([0.25, 2.0, 3.0][: columns // 3] / sigma, 3), rtol=1e-5)
    assert_allclose(normalized(raw, scale), (exact - scale.mean) * scale.factor, atol=1e-4)


@pytest.mark.parametrize(
    ("first", "value", "spread", "counts"),
    [
        # Rounding of L, a, b near 50 is up to 51e-5, of meters near 1 up to 1e-6; of normals as of meters.
        (0, 50.0, 4e-4, False),
        (0, 50.0, 8e-4, True),
        (0, 0.0, 0.8e-5, False),
        (0, 0.0, 1.3e-5, True),
        (3, 1.0, 0.6e-6, False),
        (3, 1.0, 2e-6, True),
        (3, 0.0, 1e-9, True),
        (6, 1.0, 2e-6, True),
    ],
)
def test_a_spread_of_rounding_is_none(first, value, spread, counts):
    raw = np.random.default_rng(5).normal(size=(40, 9)).astype(np.float32)
    raw[:, first : first + 3] = 0.0
    # All of the spread along one axis: the mean of three deviations is a third of it.
    raw[:, first] = value + 3 * spread * np.where(np.arange(40) % 2, 1, -1)
    factor = normalization(raw, 1.0).factor
    assert (factor[first : first + 3] > 0).all() == counts
    assert (factor[first : first + 3] == 0).all() != counts
    assert (np.delete(factor, np.s_[first : first + 3]) > 0).all()
