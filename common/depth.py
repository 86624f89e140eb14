"""Depth in any unit as the sensor's millimeters."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Many cameras and converters mark a pixel without depth by the largest value of 16 bits.
SATURATED = 65_535
#: No depth camera measures anything nearer, millimeters, and none reaches as many meters.
_NEAREST_MM = 200.0


def millimeters(depth: NDArray[Any], *, units_per_meter: float) -> NDArray[np.uint16]:
    """Turn depth in any unit into the sensor's millimeters.

    Parameters
    ----------
    depth : (H, W) number
        Depth; 0, negative, not finite or 65535 where there is none.
    units_per_meter : float
        How many of its units are a meter.

    Returns
    -------
    (H, W) uint16
        Depth, millimeters; 0 where there is none or it does not fit.
    """
    if depth.dtype == np.uint16 and units_per_meter == 1000.0:
        return np.where(depth == SATURATED, np.uint16(0), depth)
    if depth.dtype == np.float16:
        # Beyond 65.5 it has no numbers.
        depth = depth.astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = np.rint(np.nan_to_num(depth * (1000.0 / units_per_meter), nan=0.0, posinf=0.0, neginf=0.0))
    scaled[(scaled < 0) | (scaled >= SATURATED) | (depth == SATURATED)] = 0
    return scaled.astype(np.uint16)


def millimeters_by_type(depth: NDArray[Any]) -> NDArray[np.uint16]:
    """Return (H, W) depth as `millimeters` does: uint16 is in millimeters, floating point in meters.

    Raises ValueError if it is of another type, and warns a caller's caller of meters that none can be.
    """
    if np.issubdtype(depth.dtype, np.floating):
        nearest = np.min(depth, initial=np.inf, where=np.isfinite(depth) & (depth > 0))
        if _NEAREST_MM <= nearest < np.inf:
            what = "floats are meters, and millimeters must be uint16"
            warnings.warn(f"depth: the nearest is {nearest:g}; {what}", stacklevel=3)
        return millimeters(depth, units_per_meter=1.0)
    if depth.dtype != np.uint16:
        raise ValueError(
            f"depth: expected uint16 (millimeters) or float (meters), got {depth.dtype}; if it is in "
            "millimeters, depth.astype(np.uint16)"
        )
    return millimeters(depth, units_per_meter=1000.0)
