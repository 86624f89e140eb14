"""The parts of surfaces that lie on the pixels of their segments: clamped knots, and outlines with holes."""

import math
from importlib import import_module
from typing import Any

import cv2
import numpy as np

from nurbseg.segmentation.segments import Segment
from nurbseg.segmentation.surfaces.bspline import basis_matrices
from nurbseg.segmentation.surfaces.surface import NurbsSurface

#: Greatest deviation of a simplified outline, pixels, and least area of a region or a hole, square pixels.
_SIMPLIFIED_PX, _AREA_MIN = 0.35, 2.0


def clamped(surface: NurbsSurface, window: tuple[float, float, float, float]) -> NurbsSurface:
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
    pixels = (math.ceil(top), math.ceil(left), int(bottom), int(right))
    return NurbsSurface(surface.degree, knots[1], knots[0], net[..., :3] / net[..., 3:], weights, pixels)


def extent(leaf: Segment, width: int) -> tuple[int, int, int, int]:
    """Return the first row and column of a leaf's pixels, and one past the last of each."""
    v, u = np.divmod(leaf.pixels, width)
    return int(v.min()), int(u.min()), int(v.max()) + 1, int(u.max()) + 1


def outlines(leaf: Segment, shape: tuple[int, int], surface: NurbsSurface) -> list[Any]:
    """Return the regions of a leaf's pixels on its surface, simplified, without those of a pixel or two.

    Parameters
    ----------
    leaf : Segment
        Whose pixels.
    shape : tuple of int
        Height and width of the image.
    surface : NurbsSurface
        With clamped knots, which end the regions.

    Returns
    -------
    list of shapely.Polygon
        Valid, in (column, row): the outline counterclockwise where row is up, holes clockwise. Borders run
        midway between pixels inside and outside.
    """
    shapely: Any = import_module("shapely")

    (left, right), (top, bottom) = ((each[0], each[-1]) for each in (surface.knots_u, surface.knots_v))
    # Each pixel is 3 x 3 of these, which it shares with its neighbors: outlines run through its corners.
    height, width = shape
    fine = np.zeros((2 * height + 1, 2 * width + 1), dtype=np.uint8)
    v, u = np.divmod(leaf.pixels, width)
    fine[2 * v + 1, 2 * u + 1] = 1
    whole = cv2.dilate(fine, np.ones((3, 3), np.uint8))
    contours, relations = cv2.findContours(whole, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings: dict[int, list[Any]] = {}
    for number, contour in enumerate(contours):
        # One of two points is a corner, the other the middle of a pixel's side.
        line = contour[contour.sum(axis=(1, 2)) % 2 == 1, 0] / 2.0 - 0.5
        outer = int(relations[0, number, 3])
        rings.setdefault(number if outer < 0 else outer, []).append(shapely.Polygon(line))
    found: list[Any] = []
    for outer_ring, *holes in rings.values():
        holes = [hole for hole in holes if hole.area >= _AREA_MIN]
        region = shapely.make_valid(outer_ring).difference(shapely.union_all(holes))
        region = region.simplify(_SIMPLIFIED_PX).intersection(shapely.box(left, top, right, bottom))
        region = shapely.orient_polygons(region)
        parts = getattr(region, "geoms", [region])
        found += [part for part in parts if part.geom_type == "Polygon" and part.area >= _AREA_MIN]
    return found
