"""Decides the unit that a recording's depth images are read in."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.depth import SATURATED
from nurbseg.drivers.depth_unit import DISTINCT_MIN, METRES, DepthUnit, common_factor, decided_unit

#: A Kinect's largest 11-bit disparity, the largest that is depth, and a share of pixels that may be others.
_DISPARITY_MAX, _DISPARITY_FARTHEST, _FEW = 2047, 1092, 0.01
#: The cameras of data sets with finer units than millimeters see nothing nearer.
_USUALLY_BEYOND_M = 0.4
#: No depth camera measures anything nearer, millimeters, and none reaches as many meters.
_NEAREST_MM = 200.0
#: A common factor of all values from which on they are not what a sensor measured.
_FACTOR_MIN = 8
_PGM_MAGIC = b"P5"
#: The first bytes of an image's file, and what is stored in it.
Sample = tuple[bytes, NDArray[Any]]


_DISPARITY = DepthUnit(1000.0, "a Kinect's, low byte first, by the constants of NYU Depth v2", "disparity")


@dataclass(frozen=True, slots=True)
class DepthUnits:
    """The units of a recording's whole and floating-point depth, and what is doubtful about them.

    Images in PGM files may be disparities instead.
    """

    whole: DepthUnit
    floating: DepthUnit
    pgm: DepthUnit | None = None
    doubts: tuple[str, ...] = ()

    def of(self, content: bytes, stored: NDArray[Any]) -> DepthUnit:
        """Return the unit of the depth image that is stored in a file with this content."""
        if self.pgm is not None and content.startswith(_PGM_MAGIC):
            return self.pgm
        return self.floating if stored.dtype.kind == "f" else self.whole


def decide_units(
    given: float | None, stated: DepthUnit | None, convention: DepthUnit, samples: Sequence[Sample]
) -> DepthUnits:
    """Decide the units of a recording by what the user gives, else what it states, else its form and values.

    Parameters
    ----------
    given : float or None
        Units per meter.
    stated : DepthUnit or None
        What stands beside the images.
    convention : DepthUnit
        That of whole numbers in recordings of this form.
    samples : sequence of (bytes, (H, W) array)
        Some of its images: their first bytes, and what is stored in them.
    """
    pgms = [stored for head, stored in samples if head.startswith(_PGM_MAGIC)]
    # Their values have no unit, whatever is stated of one.
    pgm = _DISPARITY if pgms and all(map(_is_swapped_disparity, pgms)) else None
    others = [sample for sample in samples if pgm is None or not sample[0].startswith(_PGM_MAGIC)]
    rotated = _rotated([stored for _, stored in others if stored.dtype == np.uint16], convention)
    if given is None and stated is not None and stated.units_per_meter != 1000.0:
        # They would be millimeters.
        rotated = None
    if given is None and (stated is None or rotated is not None):
        plain = (
            convention if convention.form != "rotated" else DepthUnit(1000.0, "its values are not rotated")
        )
        unit, floating = rotated or plain, METRES
    else:
        unit = decided_unit(given, stated or rotated, convention)
        floating = METRES if given is None and _are_metres(others, unit) else unit
    if pgms and pgm is None and all(map(_is_smoother_swapped, pgms)):
        pgm = replace(unit, reason=f"{unit.reason}; low byte first, against PGM's rule", form="swapped")
        others = [sample for sample in others if not sample[0].startswith(_PGM_MAGIC)]
    usual = convention if unit is convention else None
    return DepthUnits(unit, floating, pgm, tuple(_doubts(others, unit, floating, usual)))


def _are_metres(samples: Sequence[Sample], stated: DepthUnit) -> bool:
    """Whether floating-point depth is plausible in meters only, not in the unit that is stated."""
    floating = [
        stored[np.isfinite(stored) & (stored > 0)] for _, stored in samples if stored.dtype.kind == "f"
    ]
    values = np.concatenate(floating) if floating else np.zeros(0)
    if not values.size:
        return False
    median = float(np.median(values))
    return median / stated.units_per_meter < 0.1 <= median < 10


def _rotated(whole: Sequence[NDArray[np.uint16]], convention: DepthUnit) -> DepthUnit | None:
    """Return the unit of rotated millimeters if the values of images say that they are some, else None."""
    if convention.units_per_meter != 1000.0 or not whole:
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


def _is_swapped_disparity(image: NDArray[Any]) -> bool:
    if image.dtype != np.uint16 or image.max() <= _DISPARITY_MAX or image.byteswap().max() > _DISPARITY_MAX:
        return False
    swapped = image.byteswap()
    # At the larger ones but the last, nothing is so far away; they are depth.
    return bool(((swapped > _DISPARITY_FARTHEST) & (swapped < _DISPARITY_MAX)).mean() < _FEW)


def _is_smoother_swapped(image: NDArray[Any]) -> bool:
    """Whether the values of a 16-bit image differ far less along its rows with their bytes swapped."""
    if image.dtype != np.uint16:
        return False
    steps, swapped = (np.abs(np.diff(each.astype(np.int32))).sum() for each in (image, image.byteswap()))
    return bool(4 * swapped < steps)


def _doubts(
    samples: Sequence[Sample], whole: DepthUnit, floating: DepthUnit, usual: DepthUnit | None
) -> list[str]:
    """Return what is implausible about depth that millimeters would no longer show.

    `usual` is the unit of whole numbers if only their format says it.
    """
    for _, stored in samples:
        measured = stored[np.isfinite(stored) & (stored > 0) & (stored != SATURATED)]
        if not measured.size:
            if (stored < 0).any():
                return ["all depth is negative, as along an axis that points backward, and counts as none"]
            continue
        nearest_m = float(measured.min()) / floating.units_per_meter
        if stored.dtype.kind == "f" and nearest_m >= _NEAREST_MM:
            return [f"the nearest depth is {nearest_m:g} m"]
        if usual is not None and usual.units_per_meter > 1000 and stored.dtype == np.uint16:
            median_m = float(np.median(measured)) / usual.units_per_meter
            if median_m < _USUALLY_BEYOND_M:
                return [f"half of the depth is nearer than {median_m:.2f} m, as millimeters would be"]
        if stored.dtype.kind == "f" and float(measured.max()) == 1.0 and floating is METRES:
            return ["the farthest depth is exactly 1 m, as where it is scaled to a part of the farthest"]
        # In millimeters, every frame is checked for it as it is read.
        is_linear = stored.dtype == np.uint16 and whole.form == "linear" and whole.units_per_meter != 1000.0
        if is_linear and (factor := common_factor(measured)) >= _FACTOR_MIN:
            return [f"all depth is a multiple of {factor} units"]
    return []
