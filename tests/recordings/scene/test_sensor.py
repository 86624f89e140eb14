import numpy as np
import pytest

from nurbseg.common.frame import Intrinsics
from scene.sensor import (
    DISPARITY_STEP_PER_M,
    PROJECTOR_OFFSET_M,
    SensorModel,
    axial_noise_m,
    projector_shadow,
    quantized,
)

CAMERA = Intrinsics(320, 240, 262.5, 262.5, 159.5, 119.5)


def wall(depth_m):
    return np.full((240, 320), depth_m, dtype=np.float32)


@pytest.mark.parametrize("depth_m", [0.8, 1.5, 3.0])
def test_a_wall_is_measured_with_the_noise_and_the_steps_of_its_distance(depth_m):
    measured = SensorModel(CAMERA, 0).measure(wall(depth_m), 0) / 1000
    step = DISPARITY_STEP_PER_M * depth_m**2
    expected = np.hypot(axial_noise_m(np.float32(depth_m)), step / np.sqrt(12))
    assert measured.std() == pytest.approx(expected, rel=0.15)
    assert measured.mean() == pytest.approx(depth_m, abs=step)
    inverse_steps = np.diff(np.unique(1 / measured)) / DISPARITY_STEP_PER_M
    rounding_per_step = 1e-3 / step
    np.testing.assert_allclose(inverse_steps, np.rint(inverse_steps), atol=1.2 * rounding_per_step)
    assert (np.rint(inverse_steps) >= 1).all()


def test_quantized_depth_is_within_half_a_step():
    depth = np.linspace(0.4, 6, 500, dtype=np.float32)
    steps = np.array([quantized(each) for each in depth])
    assert (np.abs(steps - depth) <= 0.52 * DISPARITY_STEP_PER_M * depth**2 + 1e-6).all()


def test_the_projector_leaves_a_shadow_of_the_parallax_at_a_boards_left_side_only():
    depth = wall(2.0)
    depth[60:180, 120:200] = 1.0
    dark = projector_shadow(depth, CAMERA)
    width = CAMERA.fx * PROJECTOR_OFFSET_M * (1 / 1.0 - 1 / 2.0)
    assert dark[120].sum() == pytest.approx(width, abs=1.5)
    assert dark[120, 120 - int(width) + 1 : 119].all()
    assert not dark[120, 120:].any() and not dark[:60].any()


def test_what_is_too_near_too_far_or_nowhere_is_not_measured():
    depth = wall(1.0)
    depth[:, :50], depth[:, 50:100], depth[:, 100:150] = 0.2, 9.0, np.inf
    measured = SensorModel(CAMERA, 0).measure(depth, 0)
    assert (measured[:, :140] == 0).all()
    assert (measured[:, 200:] > 0).all()


def test_edges_are_ragged_and_have_holes_but_flat_parts_are_whole():
    depth = wall(1.6)
    depth[60:180, 120:200] = 1.2
    sensor = SensorModel(CAMERA, 0)
    measured = sensor.measure(depth, 0)
    below = measured[178:182, 130:190]
    assert 0.05 < (below == 0).mean() < 0.6
    edge = measured[70:170, 198:202] / 1000
    near, far = (edge > 1.1) & (edge < 1.3), (edge > 1.4)
    assert near[:, 2:].any() and far[:, :2].any()
    assert (measured[100:140, 130:190] > 0).all() and (measured[:50] > 0).all()


def test_faults_are_the_same_for_a_seed_and_frame_and_differ_otherwise():
    depth = wall(1.5)
    first = SensorModel(CAMERA, 3).measure(depth, 4)
    assert np.array_equal(first, SensorModel(CAMERA, 3).measure(depth, 4))
    assert not np.array_equal(first, SensorModel(CAMERA, 3).measure(depth, 5))
    assert not np.array_equal(first, SensorModel(CAMERA, 2).measure(depth, 4))
