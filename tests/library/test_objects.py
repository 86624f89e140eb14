"""What is measured of objects, against scenes of which it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nurbseg.common.frame import RGBDFrame
from nurbseg.library.boxes.boxes import OrientedBox
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter, process_frame
from nurbseg.segmentation.config import SegmentationConfig

FX, FY, CX, CY = 130.0, 130.0, 79.5, 59.5


def two_walls() -> RGBDFrame:
    """A red wall, z = 2 m + x / 2, and before it, at 1 m, a blue plate of 0.4 m by 0.3 m."""
    depth_m = 2.0 / (1.0 - 0.5 * (np.arange(160) - CX) / FX)
    depth = np.tile(np.rint(1e3 * depth_m).astype(np.uint16), (120, 1))
    color = np.full((120, 160, 3), (200, 40, 40), dtype=np.uint8)
    depth[40:79, 50:102] = 1000
    color[40:79, 50:102] = (20, 40, 220)
    frame = RGBDFrame.from_arrays(depth, color, FX, FY, CX, CY)
    # Neither is level.
    return replace(frame, gravity=np.array([0.0, 1.0, 0.0]))


def test_objects_are_where_they_are_and_of_their_size_and_color() -> None:
    result = process_frame(two_walls())
    labels = result.labels("objects")
    plate = result.objects[labels[60, 75] - 1]
    wall = result.objects[labels[5, 5] - 1]
    assert (plate.pixels.size, wall.pixels.size) == (39 * 52, 120 * 160 - 39 * 52)
    assert np.array_equal(labels.flat[plate.pixels], np.full(39 * 52, plate.label))
    # Columns 50 to 101 and rows 40 to 78, back-projected at 1 m.
    expected = [(75.5 - CX) / FX, (59.0 - CY) / FY, 1.0]
    assert np.allclose(plate.centroid_m, expected, atol=1e-5)
    # Of some of the points, without the outermost.
    assert np.allclose(plate.box.center_m, expected, atol=4e-3)
    assert np.allclose(plate.box.size_m, [51 / FX, 38 / FY, 0.0], atol=6e-3)
    assert np.allclose(np.abs(plate.box.axes), np.eye(3), atol=0.04)
    assert plate.mean_color.tolist() == [20, 40, 220]
    assert plate.mean_normal is not None
    assert np.allclose(plate.mean_normal, [0, 0, -1], atol=1e-3)
    assert wall.mean_normal is not None
    assert np.allclose(wall.mean_normal, np.array([0.5, 0.0, -1.0]) / np.sqrt(1.25), atol=5e-3)
    assert plate.rms_m == pytest.approx(0.0, abs=1e-5)


def test_the_mesh_of_an_object_lies_on_it_alone() -> None:
    result = process_frame(two_walls())
    for each, along in ((result.objects[0], (2.0, 0.5)), (result.objects[1], (1.0, 0.0))):
        mesh = each.mesh()
        assert len(mesh.triangles) > 100
        assert np.allclose(mesh.vertices_m[:, 2], along[0] + along[1] * mesh.vertices_m[:, 0], atol=4e-3)


def test_a_box_holds_its_points_in_any_orientation() -> None:
    rng = np.random.default_rng(3)
    for turn in Rotation.random(20, rng=rng):
        size, center = np.array([0.6, 0.4, 0.1]), rng.normal(size=3)
        corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3)
        inside = rng.uniform(-0.5, 0.5, (500, 3))
        # As many corners as are no strays.
        box = OrientedBox.around(turn.apply(np.vstack([np.tile(corners, (9, 1)), inside]) * size) + center)
        # The rectangle of least area may lie a little better than the box from which the points come.
        assert np.allclose(box.size_m, size, atol=0.02)
        assert np.allclose(box.center_m, center, atol=0.02)
        assert np.linalg.det(box.axes) == pytest.approx(1.0)
        assert np.allclose(np.abs(box.axes @ turn.as_matrix()), np.eye(3), atol=0.1)
        local = (turn.apply(corners * size) + center - box.center_m) @ box.axes.T
        assert (np.abs(local) <= box.size_m / 2 + 1e-9).all()


def test_surfaces_are_the_objects_where_nothing_is_merged(small_result: FrameResult) -> None:
    assert not small_result.tree.objects
    leaves = small_result.tree.leaves()
    assert [each.leaves for each in small_result.objects] == [(leaf.name,) for leaf in leaves]
    for each, leaf in zip(small_result.objects, leaves, strict=True):
        assert np.array_equal(each.pixels, np.sort(leaf.pixels))
        if leaf.fit.surface is not None:
            assert each.rms_m == pytest.approx(np.sqrt(leaf.fit.values["mse"]))


def test_an_object_without_a_surface_has_no_normal_and_no_residual(small_result: FrameResult) -> None:
    tree = small_result.tree
    bare = replace(tree, segments=[replace(s, fit=replace(s.fit, surface=None)) for s in tree.segments])
    for each, before in zip(replace(small_result, tree=bare).objects, small_result.objects, strict=True):
        assert (each.mean_normal, each.rms_m) == (None, None)
        assert np.array_equal(each.box.size_m, before.box.size_m)


def test_objects_keep_their_labels_from_frame_to_frame() -> None:
    segmenter = Segmenter(SegmentationConfig())
    first, second = (segmenter.process(two_walls()) for _ in range(2))
    labels = [{each.label: each.pixels.size for each in result.objects} for result in (first, second)]
    assert labels[0] == labels[1]
    assert np.array_equal(np.unique(second.labels("objects")), sorted(labels[1]))


def test_the_first_side_of_a_box_is_the_longer_one() -> None:
    # More points at the ends of the shorter side: along it they vary more.
    points = np.random.default_rng(0).uniform((-0.5, -0.45, 0.0), (0.5, 0.45, 0.01), (3999, 3))
    points[:2000, 1] = np.where(points[:2000, 1] > 0, 0.45, -0.45)
    assert points[:, 1].var() > points[:, 0].var()
    for degrees in range(0, 180, 20):
        box = OrientedBox.around(Rotation.from_euler("z", degrees, degrees=True).apply(points))
        assert np.allclose(box.size_m, [1.0, 0.9, 0.01], rtol=0.04)
        assert np.isclose(np.linalg.det(box.axes), 1.0)


def test_stray_points_do_not_make_a_box_longer() -> None:
    rng = np.random.default_rng(5)
    turn, size = Rotation.random(rng=rng), np.array([0.3, 0.2, 0.05])
    points = rng.uniform(-0.5, 0.5, (20_000, 3)) * size
    # Between the object and a wall behind it.
    points[:80, 2] = rng.uniform(0.1, 0.6, 80)
    box = OrientedBox.around(turn.apply(points))
    assert np.allclose(box.size_m, size, atol=0.01)
    assert np.allclose(box.center_m, 0.0, atol=0.005)
