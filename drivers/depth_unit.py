"""The unit of a recording's depth: decided once, with the reason, and doubted where it is implausible."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.depth import SATURATED, millimeters

_log = logging.getLogger(__name__)

#: Depth cameras of the kinds that are replayed neither see a scene as a whole beyond this nor nearer than
#: that, millimeters.
_FAR_MM, _NEAR_MM = 10_000, 100
#: Distinct values from which on a common factor is no accident; a rendered wall may have a single one.
DISTINCT_MIN = 32
#: A common factor from which on depth is not what a sensor measured: 5 is that of TUM's units.
_FACTOR_MIN = 5
#: Distinct values per image that 8 bits have at most, and pixels of which a sensor gives more.
_LEVELS_8_BITS, _LEVELS_PIXELS = 256, 10_000
#: A share of pixels that no sensor measures at exactly one depth, and how much farther it is than all others
#: where it stands for none.
_SAME_MIN, _BEYOND_MIN = 0.05, 1.25
#: A Kinect's 11-bit disparity for "nothing measured", and the farthest that it measures.
_DISPARITY_NONE, _DISPARITY_FAR_MM = 2047, 10_000


@dataclass(frozen=True, slots=True)
class DepthUnit:
    """The unit of a recording's depth.

    Parameters
    ----------
    units_per_meter : float
        How many of its units are a meter.
    reason : str
        Who says so, for a person: ``--depth-scale``, ``camera.toml: depth_scale``, ``TUM RGB-D's own``.
    form : {"linear", "rotated", "swapped", "disparity"}
        Whether 16-bit values are depth, millimeters rotated left by three bits, as in SUN RGB-D [1]_, depth
        with the low byte first in a PGM file, or a Kinect's 11-bit disparities stored so, as in the raw NYU
        Depth v2 set [2]_.

    References
    ----------
    .. [1] S. Song, S. Lichtenberg, J. Xiao, "SUN RGB-D: a RGB-D scene understanding benchmark suite",
       CVPR 2015.
    .. [2] N. Silberman, D. Hoiem, P. Kohli, R. Fergus, "Indoor segmentation and support inference from
       RGBD images", ECCV 2012.
    """

    units_per_meter: float
    reason: str
    form: Literal["linear", "rotated", "swapped", "disparity"] = "linear"

    def __str__(self) -> str:
        per_meter = f"{self.units_per_meter:g} per meter"
        text = {
            "linear": per_meter,
            "swapped": per_meter,
            "rotated": "millimeters rotated by three bits",
            "disparity": "11-bit disparity",
        }[self.form]
        return f"{text} ({self.reason})"

    def millimeters(self, depth: NDArray[Any]) -> NDArray[np.uint16]:
        """Return (H, W) depth in this unit as millimeters, as `millimeters` does."""
        if self.form == "rotated" and depth.dtype == np.uint16:
            depth = np.where(depth == SATURATED, 0, (depth >> 3) | (depth << 13)).astype(np.uint16)
        elif self.form in ("swapped", "disparity") and depth.dtype == np.uint16:
            depth = depth.byteswap()
            depth = depth if self.form == "swapped" else _of_disparity(depth)
        return millimeters(depth, units_per_meter=self.units_per_meter)


#: What floating-point depth is in where nobody says otherwise.
METRES = DepthUnit(1.0, "floating point is in meters")


def decided_unit(given: float | None, stated: DepthUnit | None, convention: DepthUnit) -> DepthUnit:
    """Return what the user gives, else what the recording states, else the format's convention.

    The log warns if the user contradicts the recording.
    """
    if given is None:
        return stated or convention
    if stated is None or (stated.units_per_meter == given and stated.form == "linear"):
        return DepthUnit(given, "--depth-scale")
    _log.warning("depth: --depth-scale %g counts, though the recording states %s", given, stated)
    return DepthUnit(given, f"--depth-scale, against {stated}")


def doubts(depth_mm: NDArray[np.uint16], unit: DepthUnit) -> Iterator[str]:
    """Yield what is implausible in the (H, W) uint16 millimeters of an image in `unit`, for a person."""
    measured = depth_mm[depth_mm > 0]
    if not measured.size:
        if unit.units_per_meter < 1000.0:
            # Of millimeters and less, 16 bits have room for no more.
            yield f"no pixel has depth of up to {SATURATED // 1000} m"
        return
    median_mm = float(np.median(measured))
    if median_mm > _FAR_MM:
        yield f"half of the depth is beyond {median_mm / 1000:.1f} m"
    elif median_mm < _NEAR_MM:
        yield f"half of the depth is nearer than {median_mm / 1000:.3f} m"
    if (factor := common_factor(measured)) >= _FACTOR_MIN:
        yield f"all depth is a multiple of {factor} mm"
    elif _is_8_bits_stretched(measured):
        yield "the depth has no more steps than 8 bits, at even distances"
    if (share := _share_of_none(measured)) >= _SAME_MIN:
        most = measured.max()
        yield f"{share:.0%} of the depth is exactly {most} mm, as for none (--range-max leaves it out)"


def common_factor(values: NDArray[np.unsignedinteger[Any]]) -> int:
    """Return the largest whole number that divides all (N,) values; 1 if they are too few to tell."""
    distinct = np.unique(values[values > 0])
    return int(np.gcd.reduce(distinct)) if distinct.size >= DISTINCT_MIN else 1


def _share_of_none(measured: NDArray[np.uint16]) -> float:
    """Return the share of (N,) millimeters that are the largest, where all others are far nearer; else 0."""
    distinct, counts = np.unique(measured, return_counts=True)
    if distinct.size < DISTINCT_MIN or distinct[-1] < _BEYOND_MIN * distinct[-2]:
        return 0.0
    return float(counts[-1] / measured.size)


def _is_8_bits_stretched(measured: NDArray[np.uint16]) -> bool:
    """Whether (N,) millimeters are evenly spaced steps, as 8 bits become when they are scaled."""
    distinct = np.unique(measured).astype(np.int64)
    if measured.size < _LEVELS_PIXELS or not DISTINCT_MIN <= distinct.size <= _LEVELS_8_BITS:
        return False
    steps, span = np.diff(distinct), float(distinct[-1] - distinct[0])
    step = span / np.rint(span / steps.min())
    return bool(steps.min() >= _FACTOR_MIN and (np.abs(steps - np.rint(steps / step) * step) <= 1.0).all())


def _of_disparity(disparity: NDArray[np.uint16]) -> NDArray[np.uint16]:
    # The constants of the NYU Depth v2 toolbox for its sensor: depth in meters = 351.3 / (1092.5 - d).
    depth_mm = 351_300.0 / (1092.5 - np.minimum(disparity, 1092))
    depth_mm[(disparity == 0) | (disparity >= _DISPARITY_NONE) | (depth_mm > _DISPARITY_FAR_MM)] = 0
    return np.rint(depth_mm).astype(np.uint16)
