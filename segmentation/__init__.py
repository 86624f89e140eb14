"""The method: arrays in, values out."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurbseg.segmentation.config import SegmentationConfig
    from nurbseg.segmentation.cut.ncut import Cut, normalized_cut
    from nurbseg.segmentation.live.tree import LiveTree
    from nurbseg.segmentation.methods import segment
    from nurbseg.segmentation.points.registration import PointMap, register
    from nurbseg.segmentation.segments import Segment, SegmentationTree
    from nurbseg.segmentation.surfaces.curvature import all_metrics, principal_curvatures
    from nurbseg.segmentation.surfaces.fit import Fit, fit_surface
    from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate, normals
    from nurbseg.segmentation.vocabulary import StopReason

__all__ = [
    "Cut",
    "Fit",
    "LiveTree",
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
    "all_metrics": "surfaces.curvature",
    "principal_curvatures": "surfaces.curvature",
    "Cut": "cut.ncut",
    "normalized_cut": "cut.ncut",
    "PointMap": "points.registration",
    "register": "points.registration",
    "Fit": "surfaces.fit",
    "NurbsSurface": "surfaces.surface",
    "evaluate": "surfaces.surface",
    "fit_surface": "surfaces.fit",
    "normals": "surfaces.surface",
    "Segment": "segments",
    "SegmentationTree": "segments",
    "StopReason": "vocabulary",
    "LiveTree": "live.tree",
    "segment": "methods",
}


def __getattr__(name: str) -> Any:
    # Late, so that a command's --help need not wait for numpy and OpenCV.
    if name in _MODULES:
        return getattr(import_module(f"nurbseg.segmentation.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
