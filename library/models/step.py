"""The surfaces of a frame as trimmed NURBS faces in a STEP file (AP242), which CAD programs read."""

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.models.modeled import Modeled
from nurbseg.library.models.trimming import clamped, extent, outlines
from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.vocabulary import display_name

#: Deviation of a face's borders in space from those on its surface, meters.
_BORDER_M = 1e-5


def write_step(objects: Sequence[Modeled], path: Path) -> None:
    """Write the surfaces of objects, trimmed to their pixels: a compound of faces for each object.

    Objects have their names (``object 3``) and mean colors, faces those of the tree's leaves (``P010``).
    Meters in the depth camera's frame: x right, y down, z forward. Raises OSError if the file cannot be
    written.

    References
    ----------
    .. [1] ISO 10303-242, "Managed model-based 3D engineering".
    """
    # Open CASCADE. Its type hints are large, and checking them slow.
    occ: Any = import_module("OCP.OCP")
    occ.Message.Message.DefaultMessenger_s().ChangePrinters().Clear()
    document = occ.TDocStd.TDocStd_Document(occ.TCollection.TCollection_ExtendedString("BinXCAF"))
    tools = occ.XCAFDoc.XCAFDoc_DocumentTool
    tools.SetLengthUnit_s(document, 1.0)
    shapes, colors = tools.ShapeTool_s(document.Main()), tools.ColorTool_s(document.Main())
    with_faces = [(each, faces) for each in objects if (faces := [*_faces(occ, each)])]
    for each, faces in with_faces:
        label = shapes.AddShape(_compound(occ, [face for _, face in faces]), False)
        _name(occ, label, each.name)
        red, green, blue = (each.mean_color / 255.0).tolist()
        color = occ.Quantity.Quantity_Color(
            red, green, blue, occ.Quantity.Quantity_TypeOfColor.Quantity_TOC_sRGB
        )
        colors.SetColor(label, color, occ.XCAFDoc.XCAFDoc_ColorType.XCAFDoc_ColorSurf)
        for name, face in faces:
            _name(occ, shapes.AddSubShape(label, face), name)
    if not with_faces:
        # A file without any shape cannot be written.
        shapes.AddShape(_compound(occ, []), False)
    writer = occ.STEPCAFControl.STEPCAFControl_Writer()
    # The settings exist only with a writer.
    static = occ.Interface.Interface_Static
    static.SetCVal_s("write.step.schema", "AP242DIS")
    static.SetCVal_s("write.step.unit", "M")
    static.SetIVal_s("write.stepcaf.subshapes.name", 1)
    writer.Transfer(document)
    if writer.Write(str(path)) != occ.IFSelect.IFSelect_ReturnStatus.IFSelect_RetDone:
        raise OSError(f"{path}: Open CASCADE cannot write it")


def _compound(occ: Any, faces: Sequence[Any]) -> Any:
    builder, compound = occ.BRep.BRep_Builder(), occ.TopoDS.TopoDS_Compound()
    builder.MakeCompound(compound)
    for face in faces:
        builder.Add(compound, face)
    return compound


def _name(occ: Any, label: Any, name: str) -> None:
    occ.TDataStd.TDataStd_Name.Set_s(label, occ.TCollection.TCollection_ExtendedString(name))


def _faces(occ: Any, found: Modeled) -> Iterator[tuple[str, Any]]:
    """Yield the name and the faces of each surface of an object: one for each connected part."""
    for leaf, whole in found.surfaces:
        top, left, bottom, right = extent(leaf, found.tree.shape[1])
        # Pixels extend half a pixel beyond their centers.
        surface = clamped(whole, (top - 0.5, left - 0.5, bottom + 0.5, right + 0.5))
        geometry = _geometry(occ, surface)
        for region in outlines(leaf, found.tree.shape, surface):
            outer, *holes = (
                _wire(occ, np.array(ring.coords), geometry) for ring in (region.exterior, *region.interiors)
            )
            made = occ.BRepBuilderAPI.BRepBuilderAPI_MakeFace(geometry, outer, True)
            for hole in holes:
                made.Add(hole)
            yield display_name(leaf.name), made.Face()


def _geometry(occ: Any, surface: NurbsSurface) -> Any:
    """Return Open CASCADE's form of a surface: distinct knots with multiplicities, arrays from 1."""
    collections = occ.collections
    rows, columns = surface.weights.shape
    poles, weights = (
        collections.Array2_gp_Pnt(1, columns, 1, rows),
        collections.Array2_double(1, columns, 1, rows),
    )
    for v in range(rows):
        for u in range(columns):
            poles.SetValue(u + 1, v + 1, occ.gp.gp_Pnt(*surface.control_points_m[v, u].tolist()))
            weights.SetValue(u + 1, v + 1, float(surface.weights[v, u]))
    (knots_u, number_u), (knots_v, number_v) = (
        _knots(occ, each) for each in (surface.knots_u, surface.knots_v)
    )
    return occ.Geom.Geom_BSplineSurface(poles, weights, knots_u, knots_v, number_u, number_v, *surface.degree)


def _knots(occ: Any, knots: NDArray[np.float64]) -> tuple[Any, Any]:
    values, counts = np.unique(knots, return_counts=True)
    found = occ.collections.Array1_double(1, values.size), occ.collections.Array1_int(1, values.size)
    for place, (value, count) in enumerate(zip(values.tolist(), counts.tolist(), strict=True), 1):
        found[0].SetValue(place, value)
        found[1].SetValue(place, count)
    return found


def _wire(occ: Any, line: NDArray[np.float64], geometry: Any) -> Any:
    """Return a closed line in a surface's parameters as a wire: an edge for each of its straight parts.

    One B-spline of degree 1 would be smaller, but Open CASCADE, and so FreeCAD, computes wrong areas with it.
    """
    api = occ.BRepBuilderAPI
    made = api.BRepBuilderAPI_MakeWire()
    corners = [occ.gp.gp_Pnt2d(u, v) for u, v in line[:-1].tolist()]
    points = [geometry.Value(corner.X(), corner.Y()) for corner in corners]
    vertices = [api.BRepBuilderAPI_MakeVertex(point).Vertex() for point in points]
    for number, corner in enumerate(corners):
        after = (number + 1) % len(corners)
        part = occ.GC.GC_MakeSegment2d(corner, corners[after]).Value()
        made.Add(api.BRepBuilderAPI_MakeEdge(part, geometry, vertices[number], vertices[after]).Edge())
    wire = made.Wire()
    occ.BRepLib.BRepLib.BuildCurves3d_s(wire, _BORDER_M)
    return wire
