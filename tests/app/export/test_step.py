"""Trimmed faces in STEP files, read again by Open CASCADE's readers."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.library.models.step import write_step
from nurbseg.library.models.trimming import outlines
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.segments import Segment
from nurbseg.segmentation.surfaces.surface import evaluate

pytest.importorskip("shapely")
occ: Any = None


@pytest.fixture(scope="module", autouse=True)
def _library() -> None:
    """Load Open CASCADE, which takes seconds, only where a test of this file runs."""
    global occ
    pytest.importorskip("OCP")
    occ = import_module("OCP.OCP")


def read(path: Path) -> dict[str, Any]:
    """Return the shapes of a file by name, with the names and colors of their faces, in meters."""
    document = occ.TDocStd.TDocStd_Document(occ.TCollection.TCollection_ExtendedString("BinXCAF"))
    tools = occ.XCAFDoc.XCAFDoc_DocumentTool
    tools.SetLengthUnit_s(document, 1.0)
    reader = occ.STEPCAFControl.STEPCAFControl_Reader()
    reader.SetNameMode(True)
    reader.SetColorMode(True)
    occ.Interface.Interface_Static.SetIVal_s("read.stepcaf.subshapes.name", 1)
    assert reader.ReadFile(str(path)) == occ.IFSelect.IFSelect_ReturnStatus.IFSelect_RetDone
    assert reader.Transfer(document)
    shapes, colors = tools.ShapeTool_s(document.Main()), tools.ColorTool_s(document.Main())
    labels = occ.collections.Sequence_TDF_Label()
    shapes.GetFreeShapes(labels)
    found = {}
    for label in (labels.Value(number) for number in range(1, labels.Length() + 1)):
        parts = occ.collections.Sequence_TDF_Label()
        shapes.GetSubShapes_s(label, parts)
        names = [name_of(parts.Value(number)) for number in range(1, parts.Length() + 1)]
        shape, color, rgb = shapes.GetShape_s(label), occ.Quantity.Quantity_Color(), []
        faces = faces_of(shape)
        for face in faces:
            assert colors.GetColor(face, occ.XCAFDoc.XCAFDoc_ColorType.XCAFDoc_ColorSurf, color)
            linear = np.array([color.Red(), color.Green(), color.Blue()])
            rgb.append(np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))
        found[name_of(label)] = SimpleNamespace(shape=shape, faces=faces, names=names, rgb=np.array(rgb))
    return found


def name_of(label: Any) -> str:
    name = occ.TDataStd.TDataStd_Name()
    assert label.FindAttribute(occ.TDataStd.TDataStd_Name.GetID_s(), name)
    return name.Get().ToExtString()


def faces_of(shape: Any) -> list[Any]:
    explorer, faces = occ.TopExp.TopExp_Explorer(shape, occ.TopAbs.TopAbs_ShapeEnum.TopAbs_FACE), []
    while explorer.More():
        faces.append(explorer.Current())
        explorer.Next()
    return faces


def area_of(shape: Any) -> float:
    properties = occ.GProp.GProp_GProps()
    occ.BRepGProp.BRepGProp.SurfaceProperties_s(shape, properties)
    return float(properties.Mass())


def is_valid(shape: Any) -> bool:
    return bool(occ.BRepCheck.BRepCheck_Analyzer(shape).IsValid())


def area_of_pixels(leaf: Segment, width: int) -> float:
    """The area of a leaf's surface, pixel by pixel from its corners."""
    v, u = np.divmod(leaf.pixels, width)
    surface = leaf.fit.surface
    across = evaluate(surface, u + 0.5, v) - evaluate(surface, u - 0.5, v)
    down = evaluate(surface, u, v + 0.5) - evaluate(surface, u, v - 0.5)
    return float(np.linalg.norm(np.cross(across, down), axis=-1).sum())


def check(result: FrameResult, path: Path, tolerance: float) -> None:
    result.export(path)
    found = read(path)
    total = expected_total = 0.0
    surfaces = {
        each.name: [leaf for leaf in map(result.tree.__getitem__, each.leaves) if leaf.fit.surface]
        for each in result.objects
    }
    # Single pixels are no faces.
    faces = {name for name, leaves in surfaces.items() if max(leaf.pixels.size for leaf in leaves) > 2}
    assert set(found) == faces
    assert len(found) > 2
    for each in result.objects:
        if each.name not in faces:
            continue
        read_back, leaves = found[each.name], surfaces[each.name]
        assert set(read_back.names) == {f"P{leaf.name}" for leaf in leaves if leaf.pixels.size > 2}
        assert np.allclose(read_back.rgb * 255, each.mean_color, atol=1.0)
        assert all(is_valid(face) for face in read_back.faces)
        total += area_of(read_back.shape)
        expected_total += sum(area_of_pixels(leaf, result.tree.shape[1]) for leaf in leaves)
    assert total == pytest.approx(expected_total, rel=tolerance)


def test_open_cascade_reads_valid_faces_by_object_with_names_and_colors(
    merged: FrameResult, tmp_path: Path
) -> None:
    check(merged, tmp_path / "a.step", 0.01)
    text = (tmp_path / "a.step").read_text()
    assert "AP242_MANAGED_MODEL_BASED_3D_ENGINEERING" in text
    assert "LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT($,.METRE.)" in text
    # Another reader turns meters into millimeters by itself.
    reader = occ.STEPControl.STEPControl_Reader()
    assert reader.ReadFile(str(tmp_path / "a.step")) == occ.IFSelect.IFSelect_ReturnStatus.IFSelect_RetDone
    reader.TransferRoots()
    in_meters = sum(area_of(each.shape) for each in read(tmp_path / "a.step").values())
    assert area_of(reader.OneShape()) == pytest.approx(1e6 * in_meters, rel=1e-6)


# The table of the second has a hole in the middle.
@pytest.mark.parametrize(("folder", "name"), [("mosd_clutter", "clutter47"), ("mosd_learn", "learn3")])
def test_a_real_frame_has_valid_faces_of_the_labeled_area(
    real_data: Callable[[str], Path], tmp_path: Path, folder: str, name: str
) -> None:
    options = SourceOptions(intrinsics=(525, 525, 319.5, 239.5))
    with open_source(str(real_data(folder)), options) as source:
        frame = next(each for each in source if each.name == name)
    check(process_frame(frame), tmp_path / "a.step", 0.002)


@pytest.mark.parametrize("margin", [0, 1, 30])
def test_outlines_and_holes_have_opposite_directions(merged: FrameResult, margin: int) -> None:
    height, width = merged.tree.shape
    image = np.zeros((height, width), dtype=bool)
    image[margin : height - margin, margin : width - margin] = True
    image[50:60, 70:90] = False
    image[65:70, 70:90] = False
    leaf: Any = SimpleNamespace(pixels=np.flatnonzero(image))
    # Knots that end within the outline, and such that do not.
    for end in (0.0, 20.0):
        window: Any = SimpleNamespace(
            knots_u=np.array([end - 1, width - end]), knots_v=np.array([end - 1, height - end])
        )
        (region,) = outlines(leaf, (height, width), window)
        assert region.exterior.is_ccw
        assert [interior.is_ccw for interior in region.interiors] == [False, False]


def test_a_face_has_the_holes_of_its_pixels_and_each_part_a_face(merged: FrameResult, tmp_path: Path) -> None:
    height, width = merged.tree.shape
    largest = max(merged.tree.leaves(), key=lambda leaf: leaf.pixels.size)
    v, u = np.divmod(largest.pixels, width)
    image = np.zeros((height, width), dtype=bool)
    top, left = int(np.median(v)), int(np.median(u))
    image[top : top + 20, left : left + 30] = True
    # A hole of 6 x 8, one of a pixel, and a part that is connected by a corner only.
    image[top + 5 : top + 11, left + 10 : left + 18] = False
    image[top + 15, left + 25] = False
    image[top + 20 : top + 24, left + 30 : left + 34] = True
    image[top : top + 6, left + 33 : left + 39] = True
    leaf = SimpleNamespace(name="0", pixels=np.flatnonzero(image), fit=largest.fit)
    thing: Any = SimpleNamespace(
        name="thing",
        surfaces=[(leaf, leaf.fit.surface)],
        tree=SimpleNamespace(shape=(height, width)),
        mean_color=np.array([255.0, 128, 0]),
    )
    write_step([thing], tmp_path / "a.step")
    (found,) = read(tmp_path / "a.step").values()
    assert all(is_valid(face) for face in found.faces)
    wires = [len(wires_of(face)) for face in found.faces]
    assert sorted(wires) == [1, 2]
    # Corners are cut, and the small hole is filled.
    assert area_of(found.shape) == pytest.approx(area_of_pixels(leaf, width), rel=0.01)


def wires_of(face: Any) -> list[Any]:
    explorer, wires = occ.TopExp.TopExp_Explorer(face, occ.TopAbs.TopAbs_ShapeEnum.TopAbs_WIRE), []
    while explorer.More():
        wires.append(explorer.Current())
        explorer.Next()
    return wires


def test_no_object_is_an_empty_file(tmp_path: Path) -> None:
    write_step([], tmp_path / "a.step")
    text = (tmp_path / "a.step").read_text()
    assert "END-ISO-10303-21" in text
    assert "ADVANCED_FACE" not in text
