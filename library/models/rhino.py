"""The surfaces of a frame as NURBS in a Rhino file, which CAD programs read."""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.library.models.trimming import clamped, extent
from nurbseg.library.objects import MeasuredObject
from nurbseg.segmentation.segments import Segment
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate
from nurbseg.segmentation.vocabulary import display_name

#: Version of the file format.
_RHINO_VERSION = 7


def write_rhino(objects: Sequence[MeasuredObject], path: Path) -> None:
    """Write the surfaces of objects and their outlines, a layer for each object.

    rhino3dm cannot create trimmed surfaces. So a surface spans the rectangle of its segment's pixels, with
    curves on it for trimming. Meters in the depth camera's frame: x right, y down, z forward.
    """
    # Not imported directly, as its type hints are wrong.
    rhino3dm: Any = import_module("rhino3dm")
    model = rhino3dm.File3dm()
    model.ApplicationName = "nurbseg"
    model.Settings.ModelUnitSystem = rhino3dm.UnitSystem.Meters
    for each in objects:
        layer = rhino3dm.Layer()
        layer.Name = each.name
        red, green, blue = np.rint(each.mean_color).astype(int).tolist()
        layer.Color = (red, green, blue, 255)
        attributes = rhino3dm.ObjectAttributes()
        attributes.LayerIndex = model.Layers.Add(layer)
        for leaf, whole in each.surfaces:
            surface = clamped(whole, extent(leaf, each.tree.shape[1]))
            attributes.Name = display_name(leaf.name)
            model.Objects.AddSurface(_rhino_surface(rhino3dm, surface), attributes)
            attributes.Name = f"{display_name(leaf.name)} outline"
            for outline in _outlines(leaf, each.tree.shape):
                v, u = outline.T
                line = rhino3dm.Polyline(
                    [rhino3dm.Point3d(*point) for point in evaluate(surface, u, v).tolist()]
                )
                model.Objects.AddCurve(line.ToPolylineCurve(), attributes)
    model.Write(str(path), _RHINO_VERSION)


def _outlines(leaf: Segment, shape: tuple[int, int]) -> list[NDArray[np.float64]]:
    """Return the outlines of a leaf's pixels and their holes as closed lines of (row, column)."""
    mask = np.zeros(shape, dtype=np.uint8)
    mask.flat[leaf.pixels] = 1
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    lines = [contour[:, 0, ::-1].astype(np.float64) for contour in contours]
    return [np.vstack([line, line[:1]]) for line in lines if len(line) > 2]


def _rhino_surface(rhino3dm: Any, surface: NurbsSurface) -> Any:
    (p, q), (rows, columns) = surface.degree, surface.weights.shape
    made = rhino3dm.NurbsSurface.Create(3, True, p + 1, q + 1, columns, rows)
    for knots, own in ((made.KnotsU, surface.knots_u), (made.KnotsV, surface.knots_v)):
        # Rhino leaves out the first and the last knot, which have no effect.
        for place, knot in enumerate(own[1:-1].tolist()):
            knots[place] = knot
    homogeneous = np.dstack([surface.control_points_m * surface.weights[..., np.newaxis], surface.weights])
    for row in range(rows):
        for column in range(columns):
            made.Points[column, row] = rhino3dm.Point4d(*homogeneous[row, column].tolist())
    return made
