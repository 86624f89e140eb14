from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nurbseg.library.meshing import Lattices, isolines, surface_mesh
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.fit import Fit
from tests.fakes.small_scene import small_frame, small_result


def test_vertices_lie_on_the_scene_and_normals_look_at_the_camera() -> None:
    result = small_result()
    labels = result.tree.labels("surfaces")
    mesh = surface_mesh(result.tree, labels, 3.0)
    camera = result.frame.calibration.depth
    u = np.rint(camera.fx * mesh.vertices_m[:, 0] / mesh.vertices_m[:, 2] + camera.cx).astype(int)
    v = np.rint(camera.fy * mesh.vertices_m[:, 1] / mesh.vertices_m[:, 2] + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v, z = u[inside], v[inside], mesh.vertices_m[inside, 2]
    on_its_segment = labels[v, u] == mesh.labels[inside]
    assert on_its_segment.mean() > 0.9
    depth_m = result.frame.depth_mm[v, u][on_its_segment] * 1e-3
    assert np.abs(z[on_its_segment] - depth_m).max() < 0.01
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert (np.einsum("ij,ij->i", mesh.normals, mesh.vertices_m) < 0).all()


def test_triangles_cover_the_segments_and_nothing_else() -> None:
    result = small_result()
    labels = result.tree.labels("surfaces")
    step = 2.0
    mesh = surface_mesh(result.tree, labels, step)
    counts = np.bincount(mesh.labels[mesh.triangles[:, 0]], minlength=labels.max() + 1)[1:]
    area_px = counts * step**2 / 2
    sizes = np.bincount(labels.ravel())[1:]
    assert area_px == pytest.approx(sizes, rel=0.12)
    assert (mesh.labels[mesh.triangles] == mesh.labels[mesh.triangles[:, :1]]).all()


@pytest.mark.parametrize("step_px", [1.0, 4.0])
def test_vertices_carry_the_residuals_around_them(step_px: float) -> None:
    result = small_result()
    leaf = max(result.tree.leaves(), key=lambda leaf: leaf.pixels.size)
    rows, _ = np.divmod(leaf.fit.pixels, result.tree.shape[1])
    residuals = np.where(rows < 60, 0.001, 0.015)
    marked = replace(leaf, fit=replace(leaf.fit, residuals_m=residuals))
    segments = tuple(marked if segment is leaf else segment for segment in result.tree.segments)
    labels = result.tree.labels("surfaces")
    mesh = surface_mesh(SegmentationTree(segments, result.tree.shape), labels, step_px)
    of_leaf = mesh.labels == labels.reshape(-1)[leaf.pixels[0]]
    upper = mesh.vertices_m[of_leaf, 1] / mesh.vertices_m[of_leaf, 2] < -0.05
    lower = mesh.vertices_m[of_leaf, 1] / mesh.vertices_m[of_leaf, 2] > 0.05
    # A few vertices at the border have no data of their own, but the mean of the leaf.
    assert np.isclose(mesh.residuals_m[of_leaf][upper], 0.001).mean() > 0.9
    assert np.isclose(mesh.residuals_m[of_leaf][lower], 0.015).mean() > 0.9
    assert 0.0009 < mesh.residuals_m[of_leaf].min() < mesh.residuals_m[of_leaf].max() < 0.0151


def test_residuals_beyond_a_surface_s_window_touch_no_other_surface() -> None:
    result = small_result()
    labels = result.tree.labels("surfaces")
    before = surface_mesh(result.tree, labels, 4.0)
    leaf = min(result.tree.leaves(), key=lambda leaf: leaf.pixels.size)
    pixels = np.arange(labels.size)
    moved = replace(leaf, fit=replace(leaf.fit, pixels=pixels, residuals_m=np.full(pixels.size, 0.5)))
    segments = tuple(moved if segment is leaf else segment for segment in result.tree.segments)
    mesh = surface_mesh(SegmentationTree(segments, result.tree.shape), labels, 4.0)
    of_leaf = mesh.labels == labels.reshape(-1)[leaf.pixels[0]]
    np.testing.assert_allclose(mesh.residuals_m[of_leaf], 0.5)
    np.testing.assert_array_equal(mesh.residuals_m[~of_leaf], before.residuals_m[~of_leaf])


def test_a_leaf_without_a_surface_is_left_out() -> None:
    result = small_result()
    leaf = result.tree.leaves()[0]
    bare = replace(leaf, fit=Fit(None, np.zeros(0), {}, "too few points", leaf.pixels))
    segments = tuple(bare if segment is leaf else segment for segment in result.tree.segments)
    tree = SegmentationTree(segments, result.tree.shape)
    assert 1 not in surface_mesh(tree, tree.labels("surfaces"), 4.0).labels


def test_a_frame_without_surfaces_gives_an_empty_mesh() -> None:
    root = small_result().tree.root
    bare = replace(root, children=(), fit=Fit(None, np.zeros(0), {}, "0 points", root.pixels), cut=None)
    frame = small_frame()
    tree = SegmentationTree((bare,), frame.depth_mm.shape)
    mesh = surface_mesh(tree, tree.labels("surfaces"), 4.0)
    assert mesh.vertices_m.shape == mesh.triangles.shape == (0, 3)


def traced(count: list[tuple[int, int]], row_of: list[int], every: int) -> list[list[int]]:
    """Follow each row, then each column, vertex by vertex."""
    along_rows: list[list[int]] = []
    along_columns: list[list[int]] = []
    start = 0
    for rows, columns in count:
        grid = [row_of[start + row * columns :][:columns] for row in range(rows)]
        turned = [list(each) for each in zip(*grid, strict=True)]
        for lines, kept in ((grid, along_rows), (turned, along_columns)):
            for line in lines[min(every, len(lines) - 1) // 2 :: every]:
                run: list[int] = []
                for vertex in [*line, -1]:
                    if vertex >= 0:
                        run.append(vertex)
                        continue
                    if len(run) > 1:
                        kept.append(run)
                    run = []
        start += rows * columns
    return along_rows + along_columns


def test_lines_follow_rows_and_columns_and_break_where_a_surface_is_trimmed() -> None:
    rng = np.random.default_rng(0)
    count = [(2, 2), (9, 5), (3, 14), (2, 6), (7, 8), (2, 2)]
    sizes = np.array([rows * columns for rows, columns in count])
    for share in (1.0, 0.8, 0.3, 0.0):
        kept = rng.random(sizes.sum()) < share
        row_of = np.where(kept, np.cumsum(kept) - 1, -1)
        lattices = Lattices(np.zeros((6, 2)), np.ones((6, 2)), np.array(count), np.cumsum(sizes) - sizes)
        rows, lengths = isolines(lattices, row_of, 4)
        lines = [each.tolist() for each in np.split(rows, np.cumsum(lengths)[:-1])] if lengths.size else []
        assert lines == traced(count, row_of.tolist(), 4)
        assert bool(lines) == (share > 0.0)


def test_each_line_runs_along_a_row_or_a_column_of_the_image() -> None:
    result = small_result()
    mesh = surface_mesh(result.tree, result.tree.labels("surfaces"), 3.0)
    assert mesh.isoline_sizes.size > 20
    for line in np.split(mesh.vertices_m[mesh.isolines], np.cumsum(mesh.isoline_sizes)[:-1]):
        # Parameters of a surface are pixels.
        extent_px = np.ptp(131.0 * line[:, :2] / line[:, 2:], axis=0)
        assert extent_px.min() < 0.5
        assert extent_px.max() > 2.0


def test_no_surface_has_no_lines() -> None:
    rows, lengths = isolines(Lattices.over([], 4.0), np.zeros(0, dtype=np.int64), 4)
    assert rows.size == lengths.size == 0
