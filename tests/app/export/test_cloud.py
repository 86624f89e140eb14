"""Points as files, read again by trimesh, and by Open3D where it is installed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nurbseg.app.export.cloud import cloud_file, surface_normals
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.surfaces.surface import normals


def test_trimesh_reads_all_of_a_ply_cloud(merged: FrameResult, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "cloud.ply"
    path.write_bytes(cloud_file(merged))
    cloud = trimesh.load(path)
    valid = merged.cloud.valid
    assert np.array_equal(cloud.vertices, merged.cloud.points_m[valid])
    assert np.array_equal(cloud.colors[:, :3], merged.cloud.color[valid])
    read = cloud.metadata["_ply_raw"]["vertex"]["data"]
    for name, level in (("label", None), ("surface", "surfaces"), ("object", "objects")):
        assert np.array_equal(np.ravel(read[name]), merged.labels(level)[valid])
        assert read[name].dtype == np.uint16
    for axis, name in enumerate(("nx", "ny", "nz")):
        assert np.array_equal(np.ravel(read[name]), surface_normals(merged.tree)[valid][:, axis])


def test_open3d_reads_a_cloud(merged: FrameResult, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    path = tmp_path / "cloud.ply"
    path.write_bytes(cloud_file(merged))
    cloud = open3d.io.read_point_cloud(str(path), remove_nan_points=True)
    valid = merged.cloud.valid
    assert np.allclose(cloud.points, merged.cloud.points_m[valid])
    assert np.allclose(np.asarray(cloud.colors) * 255, merged.cloud.color[valid])
    assert np.allclose(cloud.normals, surface_normals(merged.tree)[valid])


def test_normals_are_those_of_the_surfaces_towards_the_camera(merged: FrameResult) -> None:
    image = surface_normals(merged.tree)
    for leaf in merged.tree.leaves():
        surface = leaf.fit.surface
        if surface is None:
            assert not image.reshape(-1, 3)[leaf.pixels].any()
            continue
        some = leaf.pixels[::97]
        v, u = np.divmod(some, image.shape[1])
        found = image[v, u]
        assert np.allclose(found, -normals(surface, u, v), atol=1e-6)
        towards = np.einsum("nk,nk->n", found, merged.cloud.points_m[v, u])
        assert (towards < 0).mean() > 0.95


def test_a_surface_without_a_tangent_plane_has_no_normal(merged: FrameResult) -> None:
    leaf = next(leaf for leaf in merged.tree.leaves() if leaf.fit.surface is not None)
    point = replace(leaf.fit.surface, control_points_m=np.ones_like(leaf.fit.surface.control_points_m))
    changed = replace(leaf, fit=replace(leaf.fit, surface=point))
    segments = tuple(changed if segment is leaf else segment for segment in merged.tree.segments)
    image = surface_normals(replace(merged.tree, segments=segments))
    assert not image.reshape(-1, 3)[leaf.pixels].any()
