"""The unit of a recording's depth: stated by its format or by the user, never guessed from the values."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.depth import SATURATED, millimeters
from nurbseg.common.errors import RecordingFormatError

_log = logging.getLogger(__name__)

#: The median depth of an indoor scene lies between these, meters.
_NEAR_M, _FAR_M = 0.1, 10.0
#: So many distinct values share a factor of this size only if a sensor's millimeters were scaled.
_DISTINCT_MIN, _FACTOR_MIN = 32, 5
#: Units per meter that data sets use, which are suggested where millimeters are implausible.
_SUGGESTED = (1000, 5000, 10_000, 100, 1)


@dataclass(frozen=True, slots=True)
class DepthUnit:
    """The unit of a recording's depth.

    Parameters
    ----------
    units_per_meter : float
        How many of its units are a meter.
    reason : str
        Who states it, for a person: ``--depth-scale``, ``camera.toml: depth_scale``, ``TUM RGB-D's own``.
    """

    units_per_meter: float
    reason: str

    def __str__(self) -> str:
        return f"{self.units_per_meter:g} per meter ({self.reason})"

    def millimeters(self, depth: NDArray[Any]) -> NDArray[np.uint16]:
        """Return (H, W) depth in this unit as millimeters, as `millimeters` does."""
        return millimeters(depth, units_per_meter=self.units_per_meter)


#: What depth is in where neither the recording nor the user states it.
MILLIMETERS = DepthUnit(1000.0, "the default for whole numbers")
METERS = DepthUnit(1.0, "the default for floating point")


def decided_unit(given: float | None, stated: DepthUnit | None, convention: DepthUnit) -> DepthUnit:
    """Return the unit that the user gives, else what the recording states, else the format's convention.

    The log warns if the user contradicts the recording.
    """
    if given is None:
        return stated or convention
    if stated is None or stated.units_per_meter == given:
        return DepthUnit(given, "--depth-scale")
    _log.warning("depth: --depth-scale %g counts, though the recording states %s", given, stated)
    return DepthUnit(given, f"--depth-scale, against {stated}")


@dataclass(frozen=True, slots=True)
class ImageUnits:
    """The units of whole and of floating-point depth in the image files of one recording."""

    whole: DepthUnit = MILLIMETERS
    floating: DepthUnit = METERS

    def of(self, stored: NDArray[Any]) -> DepthUnit:
        """Return the unit of (H, W) depth as it is stored."""
        return self.floating if stored.dtype.kind == "f" else self.whole

    def check(self, images: Sequence[NDArray[Any]], where: str) -> None:
        """Check that (H, W) images of a recording are plausible in a default unit.

        Raises RecordingFormatError, which says how to state the unit of `where`, if half of their depth is
        beyond 10 m or nearer than 0.1 m, or if all values share a factor.
        """
        measured = [image[np.isfinite(image) & (image > 0) & (image != SATURATED)] for image in images]
        values = np.concatenate([np.zeros(0, np.uint16), *measured])
        unit = self.of(values)
        if not values.size or unit not in (MILLIMETERS, METERS):
            return
        stored = float(np.median(values))
        factor = _common_factor(values)
        if factor >= _FACTOR_MIN:
            what, scale = f"all depth is a multiple of {factor}", factor * unit.units_per_meter
        elif not _NEAR_M <= stored / unit.units_per_meter <= _FAR_M:
            side = "beyond" if stored / unit.units_per_meter > _FAR_M else "nearer than"
            what = f"half of the depth is {side} {_FAR_M if side == 'beyond' else _NEAR_M:g} m"
            scale = next((each for each in _SUGGESTED if _NEAR_M < stored / each < _FAR_M), 1000)
        else:
            return
        raise RecordingFormatError(
            f"{where}: {what} in the default unit, {unit.units_per_meter:g} per meter, and nothing states "
            f"another; state how many units are a meter: --depth-scale {scale:g} (or "
            f"--depth-scale {unit.units_per_meter:g} if the depth is right as it is)"
        )


def _common_factor(values: NDArray[Any]) -> int:
    """Return the largest whole number that divides all (N,) values; 1 if they are few or floating point."""
    distinct = np.unique(values)
    if distinct.dtype.kind == "f" or distinct.size < _DISTINCT_MIN:
        return 1
    return int(np.gcd.reduce(distinct))
