import numpy as np
import pytest

from nurbseg.evaluation.noise import measure_noise
from nurbseg.segmentation.points.registration import PointMap

SIZE = (240, 320)


def cloud_of(depth_m: np.ndarray) -> PointMap:
    """A cloud that a plain camera sees; only its depth counts."""
    points_m = np.repeat(depth_m[..., np.newaxis], 3, axis=2).astype(np.float32)
    return PointMap(points_m, np.zeros((*depth_m.shape, 3), dtype=np.uint8), np.isfinite(depth_m))


def wall(noise: float, seed: int, flying: float = 0.0) -> np.ndarray:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    rng = np.random.default_rng(seed)
    inverse_depth = 0.9 - 0.0012 * columns + 0.0005 * rows + noise * rng.normal(size=SIZE)
    inverse_depth[rng.random(SIZE) < flying] = 2.0
    inverse_depth[rng.random(SIZE) < 0.5 * flying] += 8 * noise
    return 1 / inverse_depth


@pytest.mark.parametrize("noise", [5e-4, 3e-3, 6e-3])
def test_the_noise_of_a_wall_is_measured(noise):
    estimate = measure_noise(cloud_of(wall(noise, seed, flying=0.05)) for seed in range(3))
    assert estimate.inverse_depth_noise == pytest.approx(noise, rel=0.03)
    assert estimate.nearest_per_m == pytest.approx(noise, rel=0.05)
    assert estimate.farthest_per_m == pytest.approx(noise, rel=0.05)
    assert estimate.nearest_m < estimate.farthest_m
    assert estimate.frames == 3
    assert estimate.points > 0.9 * 3 * SIZE[0] * SIZE[1]


def test_the_largest_plane_is_found_among_other_surfaces():
    depth = wall(2e-3, 0)
    depth[:100, :150] = 0.8
    depth[150:, 200:] = 0.6 + 0.1 * np.random.default_rng(1).random((90, 120))
    assert measure_noise([cloud_of(depth)]).inverse_depth_noise == pytest.approx(2e-3, rel=0.05)


def test_a_perfect_plane_has_next_to_no_noise():
    # Of few points, the same are often drawn twice.
    for part in (slice(None), slice(5)):
        estimate = measure_noise([cloud_of(wall(0.0, 0)[part, part])])
        assert estimate.inverse_depth_noise < 1e-6
        assert estimate.points >= 25


def test_frames_without_a_plane_are_refused():
    rng = np.random.default_rng(0)
    clutter = cloud_of(1 / rng.uniform(0.2, 2.0, SIZE))
    empty, line = cloud_of(np.full(SIZE, np.nan)), wall(0.0, 0)
    line[1:] = np.nan
    with pytest.raises(ValueError, match="plane"):
        measure_noise([clutter, empty, cloud_of(line)])
