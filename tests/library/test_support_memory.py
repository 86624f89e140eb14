"""The support of frames that continue each other: what is out of sight stays what objects stand on."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from standing import BOXES, StandingBox, looking, seen

from nurbseg.library.boxes.support_memory import SupportMemory, turn_between
from nurbseg.library.segmenter import Segmenter, process_frame

WALL = StandingBox(0.0, 1.0, (6.0, 0.1, 4.0), 0.0, (90, 90, 90))
CUPBOARD = StandingBox(0.1, 0.75, (0.4, 0.3, 1.7), 0.3, (200, 60, 40))
NOISE = 0.0025


def camera(target_m):
    return looking((0.0, -0.9, 0.9), (0.0, 0.6, target_m))


def degrees_off(normal, world_from_camera):
    """Return the angle between a normal, in the camera's frame, and the vertical of the world."""
    return np.degrees(np.arccos(np.clip(world_from_camera[2, :3] @ normal, -1.0, 1.0)))


@pytest.mark.parametrize("source_knows_poses", [True, False])
def test_boxes_stay_upright_while_the_camera_looks_up_a_wall(source_knows_poses):
    # From 25 degrees down to 40 degrees up, where the wall's normal points to the top of the image.
    segmenter = Segmenter()
    for target_m in np.linspace(0.2, 2.1, 12):
        frame = seen(camera(target_m), (WALL, CUPBOARD))
        pose = camera(target_m) if source_knows_poses else None
        result = segmenter.process(replace(frame, world_from_camera=pose))
        for each in result.objects:
            assert degrees_off(each.support.normal, camera(target_m)) < 2.0
            assert degrees_off(each.box.axes[2], camera(target_m)) < 2.0
    alone = process_frame(frame)
    assert degrees_off(alone.objects[0].support.normal, camera(target_m)) > 45.0


def test_the_turn_is_that_of_planes_seen_in_both_frames():
    normals = np.array([[1.0, 0.0, 0.0], [0.0, -0.6, -0.8], [0.0, 0.0, -1.0]])
    before = np.column_stack([normals, [1.0, 2.0, 3.0], [4.0, 2.0, 1.0]])
    turn = Rotation.from_rotvec(np.radians([2.0, -3.0, 1.0])).as_matrix()
    now = np.column_stack([normals @ turn.T, before[:, 3:]])
    # One plane has gone, another has come.
    now[2] = 0.3, -0.4, -0.866, 1.5, 9.0
    np.testing.assert_allclose(turn_between(before, now), turn, atol=2e-3)
    assert turn_between(before, now[2:]) is None
    assert turn_between(np.zeros((0, 5)), now) is None


def test_one_plane_leaves_the_turn_about_its_normal_open_and_that_is_none():
    axis = np.array([0.48, -0.6, -0.64])
    across = np.array([0.8, 0.0, 0.6])
    turn = Rotation.from_rotvec(np.radians(4.0) * across)
    about_itself = Rotation.from_rotvec(np.radians(5.0) * axis)
    before = np.array([[*axis, 2.0, 1.0]])
    now = np.array([[*(turn * about_itself).apply(axis), 2.0, 1.0]])
    np.testing.assert_allclose(turn_between(before, now), turn.as_matrix(), atol=2e-3)


def test_a_table_that_comes_into_view_replaces_a_wall():
    memory = SupportMemory(NOISE)
    for target_m in np.linspace(2.1, -0.6, 12):
        result = process_frame(seen(camera(target_m), (WALL, CUPBOARD)))
        memory.update(result.cloud, result.tree, 0.03)
        if target_m > 1.5:
            assert degrees_off(memory.support.normal, camera(target_m)) > 45.0
    assert degrees_off(memory.support.normal, camera(-0.6)) < 2.0


def test_a_support_is_forgotten_where_nothing_tells_how_the_camera_turns():
    memory = SupportMemory(NOISE)
    table = process_frame(seen(camera(0.0), BOXES))
    memory.update(table.cloud, table.tree, 0.03)
    nothing = replace(table.tree, segments=())
    for step_s in (1.0, 0.9):
        assert memory.update(table.cloud, nothing, step_s) is None
        assert memory.support is not None
    memory.update(table.cloud, nothing, 0.2)
    assert memory.support is None


def test_gravity_says_how_a_support_out_of_sight_is_turned():
    memory = SupportMemory(NOISE)
    table = process_frame(seen(camera(0.0), BOXES))
    down = camera(0.0)[:3, :3].T @ [0.0, 0.0, -1.0]
    memory.update(table.cloud, table.tree, 0.03, gravity=down)
    turned = Rotation.from_rotvec([0.5, 0.0, 0.2]).apply(down)
    memory.update(table.cloud, replace(table.tree, segments=()), 5.0, gravity=turned)
    np.testing.assert_array_equal(memory.support.normal, -turned)
