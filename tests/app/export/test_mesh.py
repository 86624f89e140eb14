"""Meshes as files, read again by trimesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame

trimesh: Any = None


@pytest.fixture(scope="module", autouse=True)
def _library() -> None:
    """Load trimesh, which takes a second, only where a test of this file runs."""
    global trimesh
    trimesh = pytest.importorskip("trimesh")


def written(result: FrameResult, form: str, folder: Path) -> Path:
    path = folder / f"mesh.{form}"
    result.export(path)
    return path


def test_a_glb_scene_has_each_object_by_name_where_it_is(merged: FrameResult, tmp_path: Path) -> None:
    scene = trimesh.load(written(merged, "glb", tmp_path))
    expected = {f"object {each.label}": each for each in merged.objects if len(each.mesh().triangles)}
    assert len(expected) > 3
    assert set(scene.graph.nodes_geometry) == set(expected)
    for name, each in expected.items():
        placed, geometry = scene.graph[name]
        mesh, own = scene.geometry[geometry], each.mesh()
        # glTF: y up, and the camera looks along -z.
        turned = mesh.vertices @ placed[:3, :3].T + placed[:3, 3]
        assert np.allclose(turned * [1, -1, -1], own.vertices_m, atol=1e-6)
        assert np.array_equal(mesh.faces, own.triangles)
        assert np.allclose(mesh.vertex_normals, own.normals, atol=1e-5)
        # The photo is on it: where the camera sees a vertex, it has the color of that point.
        photo = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
        height, width, _ = photo.shape
        # In trimesh, v points up. Pixels have their centers at whole numbers.
        column, row = (mesh.visual.uv * (width, -height) + (-0.5, height - 0.5)).T
        camera = merged.frame.calibration.depth
        x, y, z = own.vertices_m.T
        assert np.allclose(column, x / z * camera.fx + camera.cx, atol=1e-3)
        assert np.allclose(row, y / z * camera.fy + camera.cy, atol=1e-3)
        row, column = np.rint(row).astype(int), np.rint(column).astype(int)
        assert np.array_equal(photo[row, column], merged.cloud.color[row, column])


def test_a_ply_mesh_says_of_each_vertex_which_object_it_is_of(merged: FrameResult, tmp_path: Path) -> None:
    mesh = trimesh.load(written(merged, "ply", tmp_path), process=False)
    labels = np.ravel(mesh.metadata["_ply_raw"]["vertex"]["data"]["object"])
    assert set(labels) == {each.label for each in merged.objects if len(each.mesh().triangles)}
    for each in merged.objects:
        own = each.mesh()
        assert np.array_equal(mesh.vertices[labels == each.label], own.vertices_m)
        faces = mesh.faces[labels[mesh.faces[:, 0]] == each.label]
        assert np.array_equal(mesh.vertices[faces], own.vertices_m[own.triangles])


def test_one_object_alone_is_in_its_file_as_in_that_of_all(merged: FrameResult, tmp_path: Path) -> None:
    each = merged.objects[1]
    merged.object(each.label).export(tmp_path / "one.glb")
    one, all_of_them = trimesh.load(tmp_path / "one.glb"), trimesh.load(written(merged, "glb", tmp_path))
    assert set(one.graph.nodes_geometry) == {f"object {each.label}"}
    (mesh,) = one.geometry.values()
    same = all_of_them.geometry[all_of_them.graph[f"object {each.label}"][1]]
    assert np.array_equal(mesh.vertices, same.vertices) and np.array_equal(mesh.faces, same.faces)
    assert np.array_equal(mesh.visual.uv, same.visual.uv)
    with pytest.raises(ValueError, match=r"label: expected that of an object .* \(1, .*\), got 999"):
        merged.object(999)


def test_another_ending_is_named_with_those_that_there_are(merged: FrameResult, tmp_path: Path) -> None:
    for export in (merged.export, merged.objects[0].export):
        with pytest.raises(ValueError, match=r"a\.fbx: expected a name that ends in \.glb, \.ply, \.step"):
            export(tmp_path / "a.fbx")
    assert not list(tmp_path.iterdir())


def test_triangles_lie_on_the_pixels_of_their_object(merged: FrameResult) -> None:
    camera, labels = merged.frame.calibration.depth, merged.labels("objects")
    inside = outside = 0
    for each in merged.objects:
        own = each.mesh(1.0)
        centers = own.vertices_m[own.triangles].mean(axis=1)
        u = np.rint(centers[:, 0] / centers[:, 2] * camera.fx + camera.cx).astype(int)
        v = np.rint(centers[:, 1] / centers[:, 2] * camera.fy + camera.cy).astype(int)
        inside += np.count_nonzero(labels[v, u] == each.label)
        outside += np.count_nonzero(labels[v, u] != each.label)
    assert inside > 50 * outside


def test_a_frame_without_objects_gives_files_without_meshes(merged: FrameResult, tmp_path: Path) -> None:
    empty = process_frame(replace(merged.frame, depth_mm=np.zeros_like(merged.frame.depth_mm), labels=None))
    for form in ("glb", "ply"):
        assert written(empty, form, tmp_path).read_bytes()
    assert not trimesh.load(written(empty, "glb", tmp_path)).geometry
