"""A model of a structured-light depth camera, applied to a perfect depth image.

The artifacts of the PrimeSense design: noise that grows with distance, depth in steps of disparity, shadows
of the projector, ragged and missing edges, surfaces seen too obliquely, and limits of range.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I8, I64, U8, U16, Bool, compiled
from nurbseg.common.frame import Intrinsics

#: Step of inverse depth, 1/m: depth comes in steps of about 2.85e-3 z^2 meters.
DISPARITY_STEP_PER_M = 2.85e-3
#: The projector stands this far along the depth camera's x axis, meters.
PROJECTOR_OFFSET_M = 0.075
#: Nearest and farthest depth measured, meters.
RANGE_M = (0.4, 6.0)
#: Deviation, pixels, by which the place measured at an edge differs from the pixel's own.
_EDGE_JITTER_PX = 0.6
#: Difference of inverse depth between neighbors, 1/m, over which they lie on either side of an edge.
_EDGE_PER_M = 0.02
_EDGE_LOSS = 0.25
#: Inverse depth change per pixel at 640 pixels, relative to inverse depth, over which too little comes back.
_GRAZING = 0.035
#: Rows and columns by which the bank of noise is larger than the image.
_BANK_MARGIN = 61
#: Single-precision numbers: a Python number would turn results into double precision.
_ZERO, _HALF, _ONE, _STEP = (np.float32(n) for n in (0, 0.5, 1, DISPARITY_STEP_PER_M))
_EDGE = np.float32(_EDGE_PER_M)
_NEAREST, _FARTHEST = (np.float32(each) for each in RANGE_M)


@compiled
def axial_noise_m(depth_m: Any) -> Any:
    """Return the standard deviation of depth at a distance, meters.

    References
    ----------
    .. [1] C. V. Nguyen, S. Izadi and D. Lovell, "Modeling Kinect sensor noise for improved 3D
       reconstruction and tracking", 3DIMPVT 2012.
    """
    beyond = depth_m - np.float32(0.4)
    return np.float32(0.0012) + np.float32(0.0019) * (beyond * beyond)


@compiled
def quantized(depth_m: Any) -> Any:
    """Return depth at the nearest step of disparity, meters; infinity stays.

    References
    ----------
    .. [1] K. Khoshelham and S. O. Elberink, "Accuracy and resolution of Kinect depth data for indoor
       mapping applications", Sensors 12(2), 2012.
    """
    return _ONE / (np.rint(_ONE / (depth_m * _STEP)) * _STEP)


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
    dark = np.empty(depth_m.shape, dtype=np.uint8)
    _shadow(np.float32(1) / depth_m, np.float32(camera.fx * PROJECTOR_OFFSET_M), dark)
    return dark.view(np.bool_)


class SensorModel:
    """Adds a depth camera's artifacts to perfect depth images.

    Parameters
    ----------
    camera : Intrinsics
        The depth camera.
    seed : int
        Draws the noise; the same seed and frame give the same artifacts.
    """

    def __init__(self, camera: Intrinsics, seed: int) -> None:
        self._camera, self._seed = camera, seed
        height, width = camera.height, camera.width
        bank = (height + _BANK_MARGIN, width + _BANK_MARGIN)
        rng = np.random.default_rng((seed, 1))
        # Drawing normal numbers takes longer than all else: a bank, cut at a random place for each frame.
        self._axial = rng.standard_normal(bank, dtype=np.float32)
        jitter = np.rint(_EDGE_JITTER_PX * rng.standard_normal((2, *bank), dtype=np.float32))
        self._jitter = np.clip(jitter, -2, 2).astype(np.int8)
        self._lost = rng.random(bank, dtype=np.float32) < _EDGE_LOSS

    def measure(self, depth_m: NDArray[np.float32], index: int) -> NDArray[np.uint16]:
        """Return what the sensor would deliver of perfect depth, millimeters, 0 where it measures nothing.

        Parameters
        ----------
        depth_m : (H, W) float32
            Inf where there is nothing.
        index : int
            Number of the frame.
        """
        cuts = np.random.default_rng((self._seed, 2, index)).integers(0, _BANK_MARGIN + 1, (3, 2))
        inverse, around = np.float32(1) / depth_m, np.ones((3, 3), np.uint8)
        highest: Any = cv2.dilate(inverse, around)
        lowest: Any = cv2.erode(inverse, around)
        # Single dark pixels are bridged by the sensor's correlation window, larger ones are widened by it.
        dark: Any = cv2.medianBlur(projector_shadow(depth_m, self._camera).view(np.uint8), 3)
        depth_mm = np.empty(depth_m.shape, dtype=np.uint16)
        grazing = np.float32(_GRAZING * 640 / depth_m.shape[1])
        banks = self._axial, self._jitter, self._lost
        _measure(depth_m, inverse, highest, lowest, dark, *banks, cuts, grazing, depth_mm)
        return depth_mm


@compiled
def _shadow(inverse: F32, baseline_px_m: Any, dark: U8) -> None:
    """Go through each row from its right end, up to where the projector's rays are taken."""
    for row in range(inverse.shape[0]):
        reached = np.float32(np.inf)
        for column in range(inverse.shape[1] - 1, -1, -1):
            # Place in the projector's image, pixels: the projector is the camera moved along x.
            place = np.float32(column) - baseline_px_m * inverse[row, column]
            reached = min(reached, place)
            dark[row, column] = place > reached + _HALF


@compiled
def _measure(
    depth_m: F32,
    inverse: F32,
    highest: F32,
    lowest: F32,
    dark: U8,
    axial: F32,
    jitter: I8,
    lost: Bool,
    cuts: I64,
    grazing: Any,
    depth_mm: U16,
) -> None:
    """Measure every pixel; `cuts` is where the image lies in the three banks of noise."""
    height, width = depth_m.shape
    moved = np.empty(width, dtype=np.float32)
    for row in range(height):
        moved[:] = depth_m[row]
        if 2 <= row < height - 2:
            down, right = jitter[:, row + cuts[1, 0], cuts[1, 1] : cuts[1, 1] + width]
            for column in range(2, width - 2):
                if highest[row, column] - lowest[row, column] > _EDGE:
                    moved[column] = depth_m[row + down[column], column + right[column]]
        axial_part = axial[row + cuts[0, 0], cuts[0, 1] : cuts[0, 1] + width]
        lost_part = lost[row + cuts[2, 0], cuts[2, 1] : cuts[2, 1] + width]
        for n in range(width):
            noisy = quantized(moved[n] + axial_noise_m(moved[n]) * axial_part[n])
            facing = highest[row, n] - lowest[row, n] <= grazing * inverse[row, n]
            seen = (dark[row, n] == 0) & (facing | (not lost_part[n]))
            # Where there is nothing, noise makes an infinity or no number at all, which is in no range.
            seen &= (noisy >= _NEAREST) & (noisy <= _FARTHEST)
            depth_mm[row, n] = np.uint16(np.rint(noisy * np.float32(1000))) if seen else np.uint16(0)
