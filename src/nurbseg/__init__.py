"""Segments the frames of depth cameras: normalized cuts, decided by NURBS surface fits.

`segment` segments a single frame, a `Segmenter` a sequence, in which segments keep their labels:

>>> frame = RGBDFrame.from_arrays(depth, color, fx=525, fy=525, cx=319.5, cy=239.5)
>>> result = segment(frame)
>>> result.labels("objects")             # (H, W) uint16
>>> [each.centroid_m for each in result.objects]

Parts of the method are in `nurbseg.segmentation`, cameras and recordings in `nurbseg.drivers`, the commands
in `nurbseg.app`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurbseg.app.view.show import show as show
    from nurbseg.library.boxes.boxes import OrientedBox as OrientedBox
    from nurbseg.library.segmenter import Segmenter as Segmenter
    from nurbseg.library.segmenter import process_frame as segment
    from nurbseg.library.objects import MeasuredObject as MeasuredObject
    from nurbseg.library.result import FrameResult as FrameResult
    from nurbseg.common.frame import Calibration as Calibration
    from nurbseg.common.frame import Intrinsics as Intrinsics
    from nurbseg.common.frame import RGBDFrame as RGBDFrame
    from nurbseg.drivers.options import SourceOptions as SourceOptions
    from nurbseg.drivers.registry import open_source as open_source
    from nurbseg.segmentation.config import SegmentationConfig as SegmentationConfig
    from nurbseg.segmentation.segments import SegmentationTree as SegmentationTree
    from nurbseg.segmentation.surfaces.surface import NurbsSurface as NurbsSurface

    __version__: str

# Imported on use, so that a command shows its help before numpy is loaded.
_HOME = {
    "Calibration": "common.frame:Calibration",
    "FrameResult": "library.result:FrameResult",
    "Intrinsics": "common.frame:Intrinsics",
    "MeasuredObject": "library.objects:MeasuredObject",
    "NurbsSurface": "segmentation.surfaces.surface:NurbsSurface",
    "OrientedBox": "library.boxes.boxes:OrientedBox",
    "RGBDFrame": "common.frame:RGBDFrame",
    "SegmentationConfig": "segmentation.config:SegmentationConfig",
    "SegmentationTree": "segmentation.segments:SegmentationTree",
    "Segmenter": "library.segmenter:Segmenter",
    "SourceOptions": "drivers.options:SourceOptions",
    "open_source": "drivers.registry:open_source",
    "segment": "library.segmenter:process_frame",
    "show": "app.view.show:show",
}

__all__ = [
    "Calibration",
    "FrameResult",
    "Intrinsics",
    "MeasuredObject",
    "NurbsSurface",
    "OrientedBox",
    "RGBDFrame",
    "SegmentationConfig",
    "SegmentationTree",
    "Segmenter",
    "SourceOptions",
    "__version__",
    "open_source",
    "segment",
    "show",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("nurbseg")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), attribute)


def __dir__() -> list[str]:
    return __all__
