"""Calibrations made from what a camera reports, and otherwise from PrimeSense's nominal values."""

import math
from dataclasses import replace

import numpy as np

from nurbseg.common.frame import Calibration, Intrinsics

#: Horizontal field of view of the depth camera of PrimeSense's design, radians: 570.3 pixels at VGA.
DEPTH_FOV = 1.0226
#: Focal length of its color camera at VGA, pixels.
COLOR_FOCAL_PX = 525.0
#: How far the color camera is to the right of the depth camera, meters.
BASELINE_M = 0.025


def _pinhole(width: int, height: int, focal_px: float) -> Intrinsics:
    """Return a camera that looks straight ahead, with the 4:3 view that these cameras have.

    An SXGA image is 5:4: it goes on below the view that the 4:3 modes show, so its optical axis is
    where it would be in the upper 1280x960 pixels.
    """
    cy = width * 3 / 8 - 0.5 if height * 4 > width * 3 else height / 2 - 0.5
    return Intrinsics(width, height, focal_px, focal_px, width / 2 - 0.5, cy)


def from_field_of_view(width: int, height: int, horizontal_fov: float | None) -> Intrinsics:
    """Return intrinsics by the field of view, radians; by the nominal one where that makes no sense."""
    fov = horizontal_fov if horizontal_fov is not None and 0.1 < horizontal_fov < 3.0 else DEPTH_FOV
    return _pinhole(width, height, width / (2 * math.tan(fov / 2)))


def color_camera(width: int, height: int) -> Intrinsics:
    """Return the nominal color camera for images of this size, pixels."""
    return _pinhole(width, height, COLOR_FOCAL_PX * width / 640)


def color_from_depth() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the nominal (4, 4) transform from the depth camera's frame to the color camera's, meters."""
    transform = np.eye(4)
    transform[0, 3] = -BASELINE_M
    return transform


def fitted(camera: Intrinsics, width: int, height: int) -> Intrinsics:
    """Return a calibrated camera for images of another size, given how 5:4 and 4:3 modes overlap."""
    return replace(camera.scaled_to(width, round(camera.height * width / camera.width)), height=height)


def mirrored(calibration: Calibration) -> Calibration:
    """Return the calibration of the same cameras with both images mirrored left to right."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    return Calibration(
        depth=_mirrored_camera(calibration.depth),
        color=_mirrored_camera(calibration.color),
        color_from_depth=flip @ calibration.color_from_depth @ flip,
    )


def _mirrored_camera(camera: Intrinsics) -> Intrinsics:
    # The terms that are odd in x: p2, the thin prism's s1 and s2, and the tilt about the y axis.
    is_odd = np.isin(np.arange(camera.distortion.size), (3, 8, 9, 13))
    distortion = np.where(is_odd, -camera.distortion, camera.distortion)
    return replace(camera, cx=camera.width - 1 - camera.cx, distortion=distortion)
