import numpy as np
import pytest

from nurbseg.segmentation.surfaces.noise import explained_by_noise, measure_noise

SIZE = (240, 320)


def wall(noise: float, seed: int, flying: float = 0.0) -> np.ndarray:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    rng = np.random.default_rng(seed)
    per_m = 0.9 - 0.0012 * columns + 0.0005 * rows + noise * rng.normal(size=SIZE)
    per_m[rng.random(SIZE) < flying] = 2.0
    return 1 / per_m


@pytest.mark.parametrize("noise", [5e-4, 3e-3, 6e-3])
def test_the_noise_of_a_wall_is_measured(cloud_of, noise):
    estimate = measure_noise(cloud_of(wall(noise, seed, flying=0.05)) for seed in range(3))
    assert estimate.noise_per_m == pytest.approx(noise, rel=0.03)
    assert estimate.nearest_per_m == pytest.approx(noise, rel=0.05)
    assert estimate.farthest_per_m == pytest.approx(noise, rel=0.05)
    assert estimate.nearest_m < estimate.farthest_m
    assert estimate.frames == 3
    assert estimate.points > 0.9 * 3 * SIZE[0] * SIZE[1]


def test_the_largest_plane_is_found_beside_other_things(cloud_of):
    depth = wall(2e-3, 0)
    depth[:100, :150] = 0.8
    depth[150:, 200:] = 0.6 + 0.1 * np.random.default_rng(1).random((90, 120))
    assert measure_noise([cloud_of(depth)]).noise_per_m == pytest.approx(2e-3, rel=0.05)


def test_a_perfect_plane_has_next_to_no_noise(cloud_of):
    assert measure_noise([cloud_of(wall(0.0, 0))]).noise_per_m < 1e-6


def test_frames_without_a_plane_are_told(cloud_of):
    rng = np.random.default_rng(0)
    clutter = cloud_of(1 / rng.uniform(0.2, 2.0, SIZE))
    empty = cloud_of(np.full(SIZE, np.nan))
    with pytest.raises(ValueError, match="plane"):
        measure_noise([clutter, empty])


def test_noise_explains_noise_and_nothing_larger():
    rng = np.random.default_rng(0)
    mask = np.ones((40, 50), dtype=bool)
    residuals = 3e-3 * rng.normal(size=mask.size)
    assert explained_by_noise(residuals, mask, 3e-3)
    assert not explained_by_noise(residuals, mask, 1.5e-3)
    residuals[: mask.size // 8] += 0.02
    assert not explained_by_noise(residuals, mask, 3e-3)


def test_flying_pixels_at_the_rim_are_forgiven():
    rng = np.random.default_rng(0)
    mask = np.ones((40, 50), dtype=bool)
    residuals = 3e-3 * rng.normal(size=mask.shape)
    residuals[0], residuals[-1], residuals[:, 0], residuals[:, -1] = (0.1,) * 4
    assert explained_by_noise(residuals[mask], mask, 3e-3)
    assert not explained_by_noise(residuals[mask], mask, 3e-3, rim=True)


def test_a_thin_thing_on_a_large_table_is_no_noise_however_small_its_share() -> None:
    rng = np.random.default_rng(2)
    mask = np.ones((240, 320), dtype=np.bool_)
    residuals = rng.normal(0.0, 2.5e-3, mask.shape)
    assert explained_by_noise(residuals[mask], mask, 2.5e-3, patch_places=60)
    residuals[100:110, 100:140] += 4 * 2.5e-3
    assert explained_by_noise(residuals[mask], mask, 2.5e-3)
    assert not explained_by_noise(residuals[mask], mask, 2.5e-3, patch_places=60)
    assert explained_by_noise(residuals[mask], mask, 2.5e-3, patch_places=900)


def test_flying_pixels_are_no_patch() -> None:
    rng = np.random.default_rng(3)
    mask = np.ones((240, 320), dtype=np.bool_)
    residuals = rng.normal(0.0, 2.5e-3, mask.shape)
    flying = rng.choice(mask.size, 1500, replace=False)
    residuals.reshape(-1)[flying] += rng.choice([-1.0, 1.0], flying.size) * 0.05
    assert explained_by_noise(residuals[mask], mask, 2.5e-3, patch_places=60)
