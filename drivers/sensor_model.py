"""What a structured-light depth camera makes of a perfect depth image.

The faults of the PrimeSense design: noise that grows with distance, depth in steps of disparity, shadows
of the projector, ragged and missing edges, surfaces seen too obliquely, and limits of range.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.frame import Intrinsics

#: Step of inverse depth, 1/m: depth comes in steps of about 2.85e-3 z^2 metres.
DISPARITY_STEP_PER_M = 2.85e-3
#: The projector stands this far along the depth camera's x axis, metres.
PROJECTOR_OFFSET_M = 0.075
#: Nearest and farthest depth measured, metres.
RANGE_M = (0.4, 6.0)
#: Deviation, pixels, by which the place measured at an edge differs from the pixel's own.
_EDGE_JITTER_PX = 0.6
#: Difference of inverse depth between neighbours, 1/m, over which they lie on either side of an edge.
_EDGE_PER_M = 0.02
_EDGE_LOSS = 0.25
#: Inverse depth change per pixel at 640 pixels, relative to inverse depth, over which too little comes back.
_GRAZING = 0.035
#: Rows and columns by which the bank of noise is larger than the image.
_BANK_MARGIN = 61


def axial_noise_m(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the standard deviation of depth at a distance, metres.

    References
    ----------
    .. [1] C. V. Nguyen, S. Izadi and D. Lovell, "Modeling Kinect sensor noise for improved 3D
       reconstruction and tracking", 3DIMPVT 2012.
    """
    return np.asarray(0.0012 + 0.0019 * (depth_m - 0.4) ** 2, dtype=np.float32)


def quantised(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return depth at the nearest step of disparity, metres; inf stays.

    References
    ----------
    .. [1] K. Khoshelham and S. O. Elberink, "Accuracy and resolution of Kinect depth data for indoor
       mapping applications", Sensors 12(2), 2012.
    """
    steps = np.rint(1 / (depth_m * np.float32(DISPARITY_STEP_PER_M)))
    with np.errstate(divide="ignore"):
        return np.asarray(1 / (steps * np.float32(DISPARITY_STEP_PER_M)), dtype=np.float32)


def projector_shadow(depth_m: NDArray[np.float32], camera: Intrinsics) -> NDArray[np.bool_]:
    """Return where the projector's light does not reach what the camera sees.

    Along a row, a point is in the dark if one to its right, nearer, takes the same ray of the projector
    or one farther left.

    Parameters
    ----------
    depth_m : (H, W) float32
        Perfect depth; inf where there is nothing.
    camera : Intrinsics
        The depth camera.
    """
    # Place of each point in the projector's image, pixels: the projector is the camera moved along x.
    columns = np.arange(depth_m.shape[1], dtype=np.float32)
    place = columns - np.float32(camera.fx * PROJECTOR_OFFSET_M) / depth_m
    reached = np.minimum.accumulate(place[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(place > reached + 0.5)


class SensorModel:
    """Adds a depth camera's faults to perfect depth images.

    Parameters
    ----------
    camera : Intrinsics
        The depth camera.
    seed : int
        Draws the noise; the same seed and frame give the same faults.
    """

    def __init__(self, camera: Intrinsics, seed: int) -> None:
        self._camera, self._seed = camera, seed
        height, width = camera.height, camera.width
        bank = (height + _BANK_MARGIN, width + _BANK_MARGIN)
        rng = np.random.default_rng((seed, 1))
        # Drawing normal numbers takes longer than all else: a bank, cut at a random place for each frame.
        self._axial = rng.standard_normal(bank, dtype=np.float32)
        jitter = np.rint(_EDGE_JITTER_PX * rng.standard_normal((2, *bank), dtype=np.float32))
        down, right = np.clip(jitter, -2, 2).astype(np.intp)
        self._jitter = down * width + right
        self._lost = rng.random(bank, dtype=np.float32) < _EDGE_LOSS
        self._places = np.arange(height * width).reshape(height, width)

    def measure(self, depth_m: NDArray[np.float32], index: int) -> NDArray[np.uint16]:
        """Return what the sensor would deliver, millimetres, 0 where it measures nothing.

        Parameters
        ----------
        depth_m : (H, W) float32
            Perfect depth; inf where there is nothing.
        index : int
            Number of the frame.
        """
        rng = np.random.default_rng((self._seed, 2, index))
        height, width = depth_m.shape
        cuts = [
            (slice(r, r + height), slice(c, c + width)) for r, c in rng.integers(0, _BANK_MARGIN + 1, (3, 2))
        ]
        inverse, around = 1 / depth_m, np.ones((3, 3), np.uint8)
        spread = cv2.dilate(inverse, around) - cv2.erode(inverse, around)
        edge = spread > _EDGE_PER_M
        edge[:2], edge[-2:], edge[:, :2], edge[:, -2:] = False, False, False, False
        moved = np.take(depth_m, self._places + self._jitter[cuts[1]] * edge)
        known = np.isfinite(moved)
        moved = np.where(known, moved, np.float32(RANGE_M[1]))
        noisy = quantised(moved + axial_noise_m(moved) * self._axial[cuts[0]])
        dark = projector_shadow(depth_m, self._camera)
        # Single dark pixels are bridged by the sensor's correlation window, larger ones are widened by it.
        dark = cv2.medianBlur(dark.view(np.uint8), 3).view(np.bool_)
        grazing = spread > _GRAZING * 640 / width * inverse
        lost = dark | (grazing & self._lost[cuts[2]])
        lost |= ~known | (noisy < RANGE_M[0]) | (noisy > RANGE_M[1])
        return np.asarray(np.where(lost, 0, np.rint(noisy * 1000)), dtype=np.uint16)
