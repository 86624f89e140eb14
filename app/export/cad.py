"""The surfaces of a frame as NURBS in a Rhino file, which CAD programs read."""

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.library.result import FrameResult
from nurbseg.segmentation.segments import Segment
from nurbseg.segmentation.surfaces.bspline import basis_matrices
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate
from nurbseg.segmentation.vocabulary import display_name

#: Version of the file format.
_RHINO_VERSION = 7


def cad_file(result: FrameResult) -> bytes:
    """Return the surfaces of a frame's leaves and their outlines, a layer for each object.

    rhino3dm cannot create trimmed surfaces. So a surface spans the rectangle of its segment's pixels, with
    curves on it for trimming. Meters in the depth camera's frame: x right, y down, z forward.
    """
    # Not imported directly, as its type hints are wrong.
    rhino3dm: Any = import_module("rhino3dm")
    model = rhino3dm.File3dm()
    model.ApplicationName = "nurbseg"
    model.Settings.ModelUnitSystem = rhino3dm.UnitSystem.Meters
    kind = "object" if result.tree.objects else "surface"
    for each in result.objects:
        layer = rhino3dm.Layer()
        layer.Name = f"{kind} {each.label}"
        red, green, blue = np.rint(each.mean_color).astype(int).tolist()
        layer.Color = (red, green, blue, 255)
        attributes = rhino3dm.ObjectAttributes()
        attributes.LayerIndex = model.Layers.Add(layer)
        for name in each.leaves:
            leaf = result.tree[name]
            if leaf.fit.surface is None or not leaf.pixels.size:
                continue
            surface = clamped(leaf.fit.surface, _extent(leaf, result.tree.shape[1]))
            attributes.Name = display_name(name)
            model.Objects.AddSurface(_rhino_surface(rhino3dm, surface), attributes)
            attributes.Name = f"{display_name(name)} outline"
            for outline in _outlines(leaf, result.tree.shape):
                v, u = outline.T
                line = rhino3dm.Polyline(
                    [rhino3dm.Point3d(*point) for point in evaluate(surface, u, v).tolist()]
                )
                model.Objects.AddCurve(line.ToPolylineCurve(), attributes)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surfaces.3dm"
        model.Write(str(path), _RHINO_VERSION)
        return path.read_bytes()


def clamped(surface: NurbsSurface, window: tuple[int, int, int, int]) -> NurbsSurface:
    """Return an identical part of a surface whose knots are clamped at its borders.

    Other programs expect a surface to start and end at control points; ours continue beyond the data.
    `window` is the part: first row, first column, and one past the last of each. As the inner knots are the
    same, the control points follow from as many points of the surface, in homogeneous coordinates.
    """
    from scipy.interpolate import make_interp_spline

    top, left, bottom, right = window
    net = np.dstack([surface.control_points_m * surface.weights[..., np.newaxis], surface.weights])
    knots = []
    for axis, (own, degree, first, last) in enumerate(
        (
            (surface.knots_v, surface.degree[1], top, bottom - 1),
            (surface.knots_u, surface.degree[0], left, right - 1),
        )
    ):
        # Outside its knots, a surface may run through infinity. A single row or column needs an extent.
        begin = min(max(first, own[degree]), own[-degree - 1] - 1.0)
        end = max(min(last, own[-degree - 1]), begin + 1.0)
        inner = own[(own > begin) & (own < end)]
        new = np.concatenate([np.full(degree + 1, begin), inner, np.full(degree + 1, end)])
        # Greville abscissae: one place for each control point.
        places = np.array([new[i + 1 : i + 1 + degree].mean() for i in range(new.size - degree - 1)])
        basis = basis_matrices(own, degree, places)[0]
        values = np.moveaxis(np.tensordot(basis, net, axes=(1, axis)), 0, axis)
        net = np.moveaxis(make_interp_spline(places, values, degree, new, axis=axis).c, 0, axis)
        knots.append(new)
    weights = np.ascontiguousarray(net[..., 3])
    return NurbsSurface(surface.degree, knots[1], knots[0], net[..., :3] / net[..., 3:], weights, window)


def _extent(leaf: Segment, width: int) -> tuple[int, int, int, int]:
    v, u = np.divmod(leaf.pixels, width)
    return int(v.min()), int(u.min()), int(v.max()) + 1, int(u.max()) + 1


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
