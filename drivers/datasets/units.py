"""Decides the unit that a recording's depth images are read in."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.depth_unit import DISTINCT_MIN, METRES, SATURATED, DepthUnit, common_factor, decided_unit

#: A Kinect's largest 11-bit disparity.
_DISPARITY_MAX = 2047
#: No depth camera measures anything nearer, millimetres, and none reaches as many metres.
_NEAREST_MM = 200.0
#: The first bytes of an image's file, and what is stored in it.
Sample = tuple[bytes, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class DepthUnits:
    """The units of a recording's whole and floating-point depth, and what is doubtful about them."""

    whole: DepthUnit
    floating: DepthUnit
    doubts: tuple[str, ...] = ()

    def of(self, stored: NDArray[Any]) -> DepthUnit:
        """Return the unit of a depth image."""
        return self.floating if stored.dtype.kind == "f" else self.whole


def decide_units(
    given: float | None, stated: DepthUnit | None, convention: DepthUnit, samples: Sequence[Sample]
) -> DepthUnits:
    """Decide the units of a recording by what the user gives, else what it states, else its form and values.

    Parameters
    ----------
    given : float or None
        Units per metre.
    stated : DepthUnit or None
        What stands beside the images.
    convention : DepthUnit
        That of whole numbers in recordings of this form.
    samples : sequence of (bytes, (H, W) array)
        Some of its images: their first bytes, and what is stored in them.
    """
    whole = [stored for _, stored in samples if stored.dtype == np.uint16]
    seen = _seen(samples, whole, convention)
    if seen is not None and (seen.form == "disparity" or (given is None and _is_millimetres(stated))):
        # Disparities have no unit, and rotated millimetres are millimetres.
        return DepthUnits(seen, METRES)
    if given is not None or stated is not None:
        # What the values look like counts against the user as what is stated does.
        unit = decided_unit(given, stated or seen, convention)
        floating = METRES if given is None and _are_metres(samples, unit) else unit
        return DepthUnits(unit, floating, tuple(_doubts(samples, floating)))
    unit = seen or (
        convention if convention.form == "linear" else DepthUnit(1000.0, "its values are not rotated")
    )
    return DepthUnits(unit, METRES, tuple(_doubts(samples, METRES)))


def _is_millimetres(stated: DepthUnit | None) -> bool:
    return stated is None or stated.units_per_metre == 1000.0


def _are_metres(samples: Sequence[Sample], stated: DepthUnit) -> bool:
    """Whether floating-point depth is plausible in metres only, not in the unit that is stated."""
    floating = [
        stored[np.isfinite(stored) & (stored > 0)] for _, stored in samples if stored.dtype.kind == "f"
    ]
    values = np.concatenate(floating) if floating else np.zeros(0)
    if not values.size:
        return False
    median = float(np.median(values))
    return median / stated.units_per_metre < 0.1 <= median < 10


def _seen(
    samples: Sequence[Sample], whole: Sequence[NDArray[np.uint16]], convention: DepthUnit
) -> DepthUnit | None:
    """Return the form of depth that its values alone tell; None if they do not."""
    pgm = [stored for head, stored in samples if head.startswith(b"P5") and stored.dtype == np.uint16]
    if pgm and all(_is_swapped_disparity(stored) for stored in pgm):
        return DepthUnit(1000.0, "a Kinect's, low byte first, by the constants of NYU Depth v2", "disparity")
    if convention.units_per_metre != 1000.0 or not whole:
        return None
    values = np.unique(np.concatenate([np.unique(stored) for stored in whole]))
    values = values[(values > 0) & (values < SATURATED)]
    if convention.form == "rotated" and values.size and not (values & 6).any():
        return convention
    # Depth under 8.192 m leaves the lowest three bits empty, and that under 16.384 m two of them. A coarser
    # step is not of this form.
    near = values[values & 7 == 0]
    is_fine = near.size == 0 or common_factor(near) == 8
    if values.size < DISTINCT_MIN or (values & 6).any() or not is_fine:
        return None
    if np.median(np.concatenate([stored[stored > 0] for stored in whole])) < 8 * _NEAREST_MM:
        return None
    return DepthUnit(1000.0, "all values are multiples of 8, as in SUN RGB-D", "rotated")


def _is_swapped_disparity(image: NDArray[np.uint16]) -> bool:
    return bool(image.max() > _DISPARITY_MAX and image.byteswap().max() <= _DISPARITY_MAX)


def _doubts(samples: Sequence[Sample], unit: DepthUnit) -> list[str]:
    """Return what is implausible about depth that millimetres would no longer show."""
    for _, stored in samples:
        measured = stored[np.isfinite(stored) & (stored > 0) & (stored != SATURATED)]
        if not measured.size:
            continue
        nearest_m = float(measured.min()) / unit.units_per_metre
        if stored.dtype.kind == "f" and nearest_m >= _NEAREST_MM:
            return [f"the nearest depth is {nearest_m:g} m"]
        factor = common_factor(measured) if stored.dtype == np.uint16 and unit.form == "linear" else 1
        if factor >= 8 and unit.units_per_metre != 1000.0:
            return [f"all depth is a multiple of {factor} units"]
    return []
