"""Calibrations made from a field of view, and how they follow the image."""

import cv2
import numpy as np
import pytest

from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers.openni2.configuration import color_camera, fitted, from_field_of_view, mirrored


@pytest.mark.parametrize("fov", [None, 0.0, float("nan"), -1.0, 4.0])
def test_a_field_of_view_that_makes_no_sense_is_replaced(fov):
    assert from_field_of_view(640, 480, fov).fx == pytest.approx(570.34, abs=0.01)


def test_a_calibration_for_vga_fits_sxga_and_back():
    vga = Intrinsics(640, 480, 520.0, 521.0, 310.0, 242.0)
    sxga = fitted(vga, 1280, 1024)
    assert (sxga.width, sxga.height) == (1280, 1024)
    # A point seen at the middle of the VGA image's pixel is between the four of the SXGA image's.
    assert pytest.approx(sxga.cx) == (310.0 + 0.5) * 2 - 0.5
    assert pytest.approx(sxga.cy) == (242.0 + 0.5) * 2 - 0.5
    back = fitted(sxga, 640, 480)
    np.testing.assert_allclose(back.matrix, vga.matrix)


def test_the_optical_axis_is_in_the_middle_of_the_4_to_3_view() -> None:
    # Of 5:4, that of the upper 960 rows; of 16:9, its own.
    rows = {(640, 480): 239.5, (320, 240): 119.5, (1280, 1024): 479.5, (1280, 720): 359.5}
    for (width, height), row in rows.items():
        camera = color_camera(width, height)
        assert (camera.cx, camera.cy) == (width / 2 - 0.5, row)
        assert camera.fx == 525 * width / 640


@pytest.mark.parametrize("terms", [5, 8, 12, 14])
def test_a_mirrored_camera_sees_the_mirrored_world_mirrored(terms, rng):
    distortion = rng.uniform(-0.02, 0.02, terms)
    camera = Intrinsics(640, 480, 520.0, 521.0, 310.0, 242.0, distortion)
    shift = np.eye(4)
    shift[:3, :3] = cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0]
    shift[:3, 3] = (-0.025, 0.002, 0.003)
    plain = Calibration(camera, camera, shift)
    turned = mirrored(plain)
    points = rng.uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 3.0), (50, 3))
    mirror = np.array([-1.0, 1.0, 1.0])

    def pixels(calibration, world):
        seen = world @ calibration.color_from_depth[:3, :3].T + calibration.color_from_depth[:3, 3]
        matrix, lens = calibration.color.matrix, calibration.color.distortion
        return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, lens)[0].reshape(-1, 2)

    straight, through_mirror = pixels(plain, points), pixels(turned, points * mirror)
    np.testing.assert_allclose(through_mirror[:, 0], 639 - straight[:, 0], atol=1e-9)
    np.testing.assert_allclose(through_mirror[:, 1], straight[:, 1], atol=1e-9)
