import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.segmentation.points.registration import PointMap, register

SIZE = (60, 80)


def test_rays_of_a_perfect_lens_are_found_to_rounding(cloud_of):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 3.0, SIZE)
    depth[rng.random(SIZE) < 0.3] = np.nan
    rays = cloud_of(depth).rays
    assert rays.focal_px == pytest.approx((64.0, 64.0), rel=1e-5)
    x, y = rays.at(np.arange(80.0), np.arange(60.0)[:, np.newaxis])
    assert_allclose(x, np.broadcast_to((np.arange(80) - 39.5) / 64, SIZE), atol=1e-6)
    assert_allclose(y, np.broadcast_to((np.arange(60)[:, np.newaxis] - 29.5) / 64, SIZE), atol=1e-6)
    assert rays.linear


def test_rays_of_a_real_lens_are_followed_to_a_fraction_of_a_pixel():
    camera = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])
    rows, columns = np.mgrid[:480, :640]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    lens = np.array([0.05, -0.12, 0.001, -0.0008])
    straight = cv2.undistortPoints(pixels, camera, lens).reshape(*rows.shape, 2)
    points = np.dstack([straight, np.ones((480, 640))]).astype(np.float32)
    cloud = PointMap(points, np.zeros((480, 640, 3), np.uint8), np.isfinite(points[..., 2]))
    x, y = cloud.rays.at(np.arange(640.0), np.arange(480.0)[:, np.newaxis])
    error_px = 525 * np.hypot(x - straight[..., 0], y - straight[..., 1])
    assert error_px.max() < 0.5
    assert np.sqrt(np.mean(error_px**2)) < 0.05


def test_rays_are_found_from_points_that_are_not_among_the_samples(cloud_of):
    depth = np.full((240, 320), np.nan)
    depth[1:4, 1:4] = 1.5
    assert cloud_of(depth).rays.focal_px == pytest.approx((256.0, 256.0), rel=1e-3)


def test_a_registered_frame_has_its_camera_s_rays_whatever_was_seen():
    camera = Intrinsics(80, 60, 64.0, 65.0, 38.0, 31.0)
    depth_mm = np.zeros(SIZE, np.uint16)
    depth_mm[40, 70] = 900
    color = np.zeros((*SIZE, 3), np.uint8)
    rays = register(RGBDFrame(0, 0, depth_mm, color, Calibration.registered(camera))).rays
    assert rays.focal_px == pytest.approx((64.0, 65.0), rel=1e-6)
    x, y = rays.at(np.arange(80.0), np.arange(60.0)[:, np.newaxis])
    assert_allclose(x, np.broadcast_to((np.arange(80) - 38.0) / 64, SIZE), atol=1e-7)
    assert_allclose(y, np.broadcast_to((np.arange(60)[:, np.newaxis] - 31.0) / 65, SIZE), atol=1e-7)


def test_a_frame_without_points_has_no_focal_length(cloud_of):
    rays = cloud_of(np.full(SIZE, np.nan)).rays
    assert rays.focal_px == (0.0, 0.0)


def test_points_that_are_not_in_front_of_the_camera_are_left_out(cloud_of):
    points = cloud_of(np.ones(SIZE)).points_m.copy()
    points[::3, ::2, 2] = 0.0
    points[1::3, ::2] *= np.float32(-1.0)
    cloud = PointMap(points, np.zeros((*SIZE, 3), np.uint8), np.ones(SIZE, dtype=np.bool_))
    assert cloud.rays.focal_px == pytest.approx((64.0, 64.0), rel=1e-5)
