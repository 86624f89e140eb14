"""The unit of a recording's depth: decided once, with the reason, and doubted if values are implausible."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Many cameras and converters mark a pixel without depth by the largest value of 16 bits.
SATURATED = 65_535
#: Depth cameras of the kinds that are replayed do not see a scene as a whole beyond this, millimetres.
_FAR_MM = 10_000
#: Distinct values from which on a common factor is no accident; a rendered wall may have a single one.
_DISTINCT_MIN = 32


@dataclass(frozen=True, slots=True)
class DepthUnit:
    """The unit of a recording's depth.

    Parameters
    ----------
    units_per_metre : float
        How many of its units are a metre.
    reason : str
        Who says so, for a person: ``--depth-scale``, ``camera.toml: depth_scale``, ``TUM RGB-D's own``.
    rotated : bool
        Whether 16-bit values are millimetres rotated left by three bits, as in SUN RGB-D [1]_.

    References
    ----------
    .. [1] S. Song, S. Lichtenberg, J. Xiao, "SUN RGB-D: a RGB-D scene understanding benchmark suite",
       CVPR 2015.
    """

    units_per_metre: float
    reason: str
    rotated: bool = False

    def __str__(self) -> str:
        form = "millimetres rotated by three bits" if self.rotated else f"{self.units_per_metre:g} per metre"
        return f"{form} ({self.reason})"

    def millimetres(self, depth: NDArray[Any]) -> NDArray[np.uint16]:
        """Return (H, W) depth in this unit as millimetres, as `millimetres` does."""
        if self.rotated and depth.dtype == np.uint16:
            depth = np.where(depth == SATURATED, 0, (depth >> 3) | (depth << 13)).astype(np.uint16)
        return millimetres(depth, units_per_metre=self.units_per_metre)


def decided_unit(given: float | None, stated: DepthUnit | None, convention: DepthUnit) -> DepthUnit:
    """Return what the user gives, else what the recording states, else the format's convention."""
    if given is not None:
        against = "" if stated is None or stated.units_per_metre == given else f", against {stated}"
        return DepthUnit(given, f"--depth-scale{against}")
    return stated or convention


def millimetres(depth: NDArray[Any], *, units_per_metre: float) -> NDArray[np.uint16]:
    """Turn depth in any unit into the sensor's millimetres.

    Parameters
    ----------
    depth : (H, W) number
        Depth; 0, negative, not finite or, of 16 bits, 65535 where there is none.
    units_per_metre : float
        How many of its units are a metre.

    Returns
    -------
    (H, W) uint16
        Depth, millimetres; 0 where there is none or it does not fit.
    """
    if depth.dtype == np.uint16:
        depth = np.where(depth == SATURATED, np.uint16(0), depth)
        if units_per_metre == 1000.0:
            return depth
    elif depth.dtype == np.float16:
        # Beyond 65.5 it has no numbers.
        depth = depth.astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = np.rint(np.nan_to_num(depth * (1000.0 / units_per_metre), nan=0.0, posinf=0.0, neginf=0.0))
    scaled[(scaled < 0) | (scaled >= SATURATED)] = 0
    return scaled.astype(np.uint16)


def doubts(depth_mm: NDArray[np.uint16]) -> Iterator[str]:
    """Yield what is implausible in the (H, W) uint16 millimetres of a depth image, for a person."""
    measured = depth_mm[depth_mm > 0]
    if not measured.size:
        return
    median_mm = float(np.median(measured))
    if median_mm > _FAR_MM:
        yield f"half of the depth is beyond {median_mm / 1000:.1f} m"
    distinct = np.unique(measured)
    if distinct.size >= _DISTINCT_MIN and not (distinct % 8).any():
        yield "all depth is a multiple of 8 mm"
