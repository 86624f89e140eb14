"""NURBS for CAD programs, read again by rhino3dm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline

from nurbseg.library.models.cad import cad_file
from nurbseg.library.models.trimming import clamped
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate


def test_a_clamped_part_is_the_same_surface() -> None:
    rng = np.random.default_rng(1)
    knots_u, knots_v = np.arange(-3.0, 9.0) * 10.0, np.sort(rng.uniform(-20.0, 80.0, 10))
    surface = NurbsSurface(
        (3, 3), knots_u, knots_v, rng.normal(size=(6, 8, 3)), rng.uniform(0.5, 2.0, (6, 8)), (0, 0, 1, 1)
    )
    top, left = int(np.ceil(knots_v[3])), 3
    bottom, right = int(knots_v[6]), 47
    part = clamped(surface, (top, left, bottom, right))
    for knots, first, last in ((part.knots_u, left, right - 1), (part.knots_v, top, bottom - 1)):
        assert knots[:4].tolist() == [first] * 4
        assert knots[-4:].tolist() == [last] * 4
    u, v = np.linspace(left, right - 1, 23), np.linspace(top, bottom - 1, 19)[:, np.newaxis]
    assert np.allclose(evaluate(part, u, v), evaluate(surface, u, v), atol=1e-9)
    # Clamped: the corner of the control net is the corner of the surface.
    corner = evaluate(surface, u[0], v[-1, 0])
    assert np.allclose(part.control_points_m[-1, 0], corner, atol=1e-9)


def test_a_part_ends_where_the_knots_do_and_has_an_extent() -> None:
    rng = np.random.default_rng(2)
    knots = np.array([0.0, 0, 0, 0, 10, 20, 20, 20, 20])
    surface = NurbsSurface((3, 3), knots, knots, rng.normal(size=(5, 5, 3)), np.ones((5, 5)), (0, 0, 21, 21))
    for window, rows, columns in (
        ((5, 4, 26, 24), (5, 20), (4, 20)),
        ((8, 20, 9, 21), (8, 9), (19, 20)),
        ((30, 0, 40, 21), (19, 20), (0, 20)),
    ):
        part = clamped(surface, window)
        assert (part.knots_v[0], part.knots_v[-1]) == rows
        assert (part.knots_u[0], part.knots_u[-1]) == columns
        u, v = np.linspace(*columns, 9), np.linspace(*rows, 9)
        assert np.allclose(
            evaluate(part, u, v[:, np.newaxis]), evaluate(surface, u, v[:, np.newaxis]), atol=1e-9
        )


@pytest.fixture(params=["stag15", "nurbseg"])
def frame_result(
    request: pytest.FixtureRequest, small_result: FrameResult, merged: FrameResult
) -> FrameResult:
    """By both methods: surfaces of equal weights, and rational ones."""
    return small_result if request.param == "stag15" else merged


def test_rhino_reads_the_same_surfaces(frame_result: FrameResult, tmp_path: Path) -> None:
    rhino3dm = pytest.importorskip("rhino3dm")
    path = tmp_path / "surfaces.3dm"
    path.write_bytes(cad_file(frame_result.objects, "3dm"))
    model = rhino3dm.File3dm.Read(str(path))
    assert model.Settings.ModelUnitSystem == rhino3dm.UnitSystem.Meters
    kind = "object" if frame_result.tree.objects else "surface"
    layer_of = {name: f"{kind} {each.label}" for each in frame_result.objects for name in each.leaves}
    found, outlines = {}, 0
    for Object in model.Objects:
        name, layer = Object.Attributes.Name, model.Layers[Object.Attributes.LayerIndex].Name
        assert layer == layer_of[name.removesuffix(" outline").removeprefix("P")]
        if name.endswith(" outline"):
            assert Object.Geometry.IsClosed
            outlines += 1
        else:
            found[name] = Object.Geometry
    leaves = [leaf for leaf in frame_result.tree.leaves() if leaf.fit.surface is not None]
    assert set(found) == {f"P{leaf.name}" for leaf in leaves}
    assert outlines >= len(leaves) > 3
    width = frame_result.tree.shape[1]
    for leaf in leaves:
        nurbs = found[f"P{leaf.name}"]
        nurbs = nurbs.Faces[0].UnderlyingSurface() if hasattr(nurbs, "Faces") else nurbs
        nurbs = nurbs.ToNurbsSurface()
        assert nurbs.IsValid
        surface = leaf.fit.surface
        assert surface is not None
        v, u = np.divmod(leaf.pixels[:: max(1, leaf.pixels.size // 20)], width)
        (first_u, last_u), (first_v, last_v) = (
            (nurbs.Domain(axis).T0, nurbs.Domain(axis).T1) for axis in (0, 1)
        )
        inside = (u >= first_u) & (u <= last_u) & (v >= first_v) & (v <= last_v)
        assert inside.mean() > 0.8
        u, v = u[inside], v[inside]
        points = np.array([_xyz(nurbs.PointAt(float(a), float(b))) for a, b in zip(u, v, strict=True)])
        # SciPy's evaluation of what was fitted.
        net = np.dstack([surface.control_points_m * surface.weights[..., None], surface.weights])
        expected = []
        for a, b in zip(u, v, strict=True):
            row = BSpline(surface.knots_v, net, surface.degree[1])(b)
            x, y, z, w = BSpline(surface.knots_u, row, surface.degree[0])(a)
            expected.append([x / w, y / w, z / w])
        assert np.allclose(points, expected, atol=1e-6)


def _xyz(point: object) -> list[float]:
    return [getattr(point, axis) for axis in "XYZ"]
