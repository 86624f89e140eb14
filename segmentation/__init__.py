"""The method: arrays in, values out."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurbseg.segmentation.config import SegmentationConfig
    from nurbseg.segmentation.curvature import all_metrics, principal_curvatures
    from nurbseg.segmentation.cut import Cut, normalized_cut
    from nurbseg.segmentation.registration import PointMap, register
    from nurbseg.segmentation.surface import Fit, NurbsSurface, evaluate, fit_surface, normals
    from nurbseg.segmentation.tree import Segment, SegmentationTree, StopReason, segment

__all__ = [
    "Cut",
    "Fit",
    "NurbsSurface",
    "PointMap",
    "Segment",
    "SegmentationConfig",
    "SegmentationTree",
    "StopReason",
    "all_metrics",
    "evaluate",
    "fit_surface",
    "normalized_cut",
    "normals",
    "principal_curvatures",
    "register",
    "segment",
]

_MODULES = {
    "SegmentationConfig": "config",
    "all_metrics": "curvature",
    "principal_curvatures": "curvature",
    "Cut": "cut",
    "normalized_cut": "cut",
    "PointMap": "registration",
    "register": "registration",
    "Fit": "surface",
    "NurbsSurface": "surface",
    "evaluate": "surface",
    "fit_surface": "surface",
    "normals": "surface",
    "Segment": "tree",
    "SegmentationTree": "tree",
    "StopReason": "tree",
    "segment": "tree",
}


def __getattr__(name: str) -> Any:
    # Late, so that a command's --help need not wait for numpy and OpenCV.
    if name in _MODULES:
        return getattr(import_module(f"nurbseg.segmentation.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
