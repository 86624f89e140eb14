"""The part of a measured object that models are made of."""

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Intrinsics
from nurbseg.library.surface_mesh import SurfaceMesh
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.surface import NurbsSurface


class Modeled(Protocol):
    """A `nurbseg.library.objects.MeasuredObject`, as files of models take it."""

    @property
    def name(self) -> str:
        """Its name in files."""

    @property
    def label(self) -> int:
        """Its label."""

    @property
    def mean_color(self) -> NDArray[np.float64]:
        """RGB from 0 to 255."""

    @property
    def cloud(self) -> PointMap:
        """Points of the frame."""

    @property
    def tree(self) -> SegmentationTree:
        """Tree of the frame."""

    @property
    def camera(self) -> Intrinsics:
        """The depth camera."""

    @property
    def surfaces(self) -> Iterator[tuple[Segment, NurbsSurface]]:
        """Its leaves with a surface, and these."""

    def mesh(self) -> SurfaceMesh:
        """Its surfaces as triangles."""
