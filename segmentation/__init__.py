"""The method: arrays in, values out."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurbseg.segmentation.config import SegmentationConfig as SegmentationConfig
    from nurbseg.segmentation.cut.ncut import Cut as Cut
    from nurbseg.segmentation.cut.ncut import normalized_cut as normalized_cut
    from nurbseg.segmentation.live.tree import LiveTree as LiveTree
    from nurbseg.segmentation.methods import segment as segment
    from nurbseg.segmentation.points.registration import PointMap as PointMap
    from nurbseg.segmentation.points.registration import Registration as Registration
    from nurbseg.segmentation.points.registration import register as register
    from nurbseg.segmentation.segments import Segment as Segment
    from nurbseg.segmentation.segments import SegmentationTree as SegmentationTree
    from nurbseg.segmentation.surfaces.curvature import all_metrics as all_metrics
    from nurbseg.segmentation.surfaces.curvature import principal_curvatures as principal_curvatures
    from nurbseg.segmentation.surfaces.fit import Fit as Fit
    from nurbseg.segmentation.surfaces.fit import fit_surface as fit_surface
    from nurbseg.segmentation.surfaces.surface import NurbsSurface as NurbsSurface
    from nurbseg.segmentation.surfaces.surface import evaluate as evaluate
    from nurbseg.segmentation.surfaces.surface import normals as normals
    from nurbseg.segmentation.vocabulary import StopReason as StopReason

# Imported on use, so that a command's --help need not wait for numpy and OpenCV.
_NAMES = {
    "config": "SegmentationConfig",
    "cut.ncut": "Cut normalized_cut",
    "live.tree": "LiveTree",
    "methods": "segment",
    "points.registration": "PointMap Registration register",
    "segments": "Segment SegmentationTree",
    "surfaces.curvature": "all_metrics principal_curvatures",
    "surfaces.fit": "Fit fit_surface",
    "surfaces.surface": "NurbsSurface evaluate normals",
    "vocabulary": "StopReason",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
