"""A calibration as a note at the end of an .oni recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.drivers.errors import RecordingFormatError
from nurbseg.drivers.frame import Calibration, Intrinsics


def calibration_note(calibration: Calibration) -> dict[str, Any]:
    """Return a calibration as a recording's note holds it."""

    def camera(each: Intrinsics) -> dict[str, Any]:
        values = {name: getattr(each, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        return values | {"distortion": each.distortion.tolist()}

    return {
        "depth": camera(calibration.depth),
        "color": camera(calibration.color),
        "color_from_depth": calibration.color_from_depth.tolist(),
    }


def calibration_of_note(path: Path, note: Any) -> Calibration:
    """Return the calibration that a recording's note holds; raises RecordingFormatError if it is none."""
    try:
        depth, color = (
            Intrinsics(**(note[name] | {"distortion": np.array(note[name]["distortion"])}))
            for name in ("depth", "color")
        )
        return Calibration(depth, color, np.array(note["color_from_depth"]))
    except (KeyError, TypeError, ValueError) as err:
        raise RecordingFormatError(f"{path}: the note's calibration: {err}") from err
