"""The objects of a frame as JSON."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.result import FrameResult
from nurbseg.drivers.frame import Intrinsics
from nurbseg.segmentation.vocabulary import display_name

#: Description of the coordinates.
CONVENTION = "depth camera, metres: x right, y down, z forward; pixel centres at whole numbers (column, row)"


def objects_document(result: FrameResult) -> dict[str, Any]:
    """Return the measurements of a frame's objects, its camera and the convention of coordinates."""
    frame = result.frame
    merged = "things" if result.tree.level == "things" else "objects"
    return {
        "frame": frame.index,
        "name": frame.name,
        "timestamp_ns": frame.timestamp_ns,
        "coordinates": CONVENTION,
        "camera": _camera_document(frame.calibration.depth),
        "level": merged if result.tree.objects else "surfaces",
        "objects": [
            {
                "object": each.label,
                "pixels": int(each.pixels.size),
                "centroid_m": _rounded(each.centroid_m),
                "box": {
                    "center_m": _rounded(each.box.center_m),
                    "size_m": _rounded(each.box.size_m),
                    "axes": [_rounded(axis) for axis in each.box.axes],
                },
                "normal": None if each.mean_normal is None else _rounded(each.mean_normal),
                "color": _rounded(each.mean_color, 2),
                "rms_m": None if each.rms_m is None else round(each.rms_m, 7),
                "leaves": [display_name(name) for name in each.leaves],
            }
            for each in result.objects
        ],
    }


def _camera_document(camera: Intrinsics) -> dict[str, Any]:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {name: getattr(camera, name) for name in names} | {"distortion": camera.distortion.tolist()}


def _rounded(values: NDArray[np.floating], digits: int = 6) -> list[float]:
    return [round(float(value), digits) for value in values]
