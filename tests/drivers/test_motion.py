"""The camera's pose and gravity: where sources have them, and what recordings keep of them."""

from dataclasses import replace

import numpy as np
import pytest
from recorded_scene import APART, REGISTERED, scenes, write_mcap, write_pairs, write_tum
from robot_bag import IMU, Bag, header, shifted

from nurbseg.common.frame import Intrinsics
from nurbseg.drivers import open_source

CAMERA = Intrinsics(96, 72, 90.0, 90.0, 47.5, 35.5)


def turned(angle: float, x_m: float = 0.0) -> np.ndarray:
    """The pose of a camera that is turned about its y axis and stands to the right."""
    pose = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[0, 3] = x_m
    return pose


@pytest.mark.parametrize("calibration", [REGISTERED, APART], ids=["registered", "apart"])
def test_poses_and_gravity_are_recorded_and_replayed(tmp_path, calibration):
    down = np.array([0.6, 0.8, 0.0])
    frames = [
        replace(frame, world_from_camera=pose, gravity=gravity)
        for frame, pose, gravity in zip(
            scenes(4, calibration),
            [turned(0.1, 1.0), None, turned(0.3), None],
            [down, 5 * down, None, None],
            strict=True,
        )
    ]
    with open_source(write_mcap(tmp_path / "a.mcap", frames)) as source:
        again = list(source)
    for one, other in zip(frames, again, strict=True):
        for name in ("world_from_camera", "gravity"):
            written, read = getattr(one, name), getattr(other, name)
            assert (written is None) == (read is None)
            if written is not None:
                np.testing.assert_allclose(read, written, atol=1e-12)
        np.testing.assert_array_equal(one.depth_mm, other.depth_mm)


def test_a_frame_checks_both():
    (frame,) = scenes(1)
    pose = turned(0.5)
    found = replace(frame, world_from_camera=pose, gravity=[0, 2, 0])
    pose[0, 3] = 7.0
    assert found.world_from_camera[0, 3] == 0.0
    assert found.gravity.tolist() == [0, 1, 0]
    for values in ({"gravity": [0, 0, 0]}, {"gravity": [0, np.nan, 1]}, {"gravity": [1, 0]}):
        with pytest.raises(ValueError, match=r"gravity: expected a finite \(3,\) vector"):
            replace(frame, **values)
    for matrix in (2 * np.eye(4), np.eye(3), np.full((4, 4), np.nan), np.diag([-1.0, 1, 1, 1])):
        with pytest.raises(ValueError, match="world_from_camera: expected a"):
            replace(frame, world_from_camera=matrix)


def test_a_tum_folder_has_the_poses_of_its_trajectory(tmp_path):
    frames = scenes(4)
    folder = write_tum(tmp_path / "tum", frames)
    seconds = [frame.timestamp_ns * 1e-9 for frame in frames]
    lines = [
        "# seconds tx ty tz qx qy qz qw",
        f"{seconds[0] + 0.015:.6f} 0 0 9 0 0 0 1",
        f"{seconds[0] + 0.004:.6f} 1 2 3 0 {np.sin(0.1):.9f} 0 {np.cos(0.1):.9f}",
        f"{seconds[1] - 0.003:.6f} 4 0 0 0 0 0 1",
        f"{seconds[1] + 0.001:.6f} 7 0 0 0 0 0 1",
        "no pose at all",
        f"{seconds[3]:.6f} 1 1 1 0 0 0 0",
        f"{seconds[3]:.6f} 5 0 0 0 0 0 1 and more",
    ]
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    with open_source(folder) as source:
        poses = [frame.world_from_camera for frame in source]
    expected = turned(0.2)
    expected[:3, 3] = [1, 2, 3]
    np.testing.assert_allclose(poses[0], expected, atol=1e-6)
    np.testing.assert_allclose(poses[1][:3, 3], [7, 0, 0])
    assert poses[2] is None
    np.testing.assert_allclose(poses[3][:3, 3], [5, 0, 0])


@pytest.mark.parametrize("text", ["", "# none\n", "x" * 1000, "1 2 3\n" * 50, "nan " * 8])
def test_a_trajectory_without_poses_leaves_the_frames(tmp_path, text):
    folder = write_tum(tmp_path / "tum", scenes(2))
    (folder / "groundtruth.txt").write_text(text)
    with open_source(folder) as source:
        assert [frame.world_from_camera for frame in source] == [None, None]


def test_pose_files_beside_images_are_read_as_far_as_they_hold_one(tmp_path):
    folder = write_pairs(tmp_path / "pairs", scenes(4))
    names = sorted(path.stem.removesuffix("_depth") for path in folder.glob("*_depth.png"))
    np.savetxt(folder / f"{names[0]}_depth.pose.txt", turned(0.2, 3.0))
    np.savetxt(folder / f"{names[1]}_depth.pose.txt", np.full((4, 4), -np.inf))
    (folder / f"{names[2]}_depth.pose.txt").write_text("1 0 0\n")
    with open_source(folder) as source:
        found = [frame.world_from_camera for frame in source]
    np.testing.assert_allclose(found[0], turned(0.2, 3.0))
    assert found[1:] == [None, None, None]


def test_gravity_of_a_robots_accelerometer_is_turned_to_the_depth_camera(tmp_path):
    """The accelerometer lies on its side beside the camera, and shows what holds it up."""
    bag = Bag(tmp_path / "a.mcap")
    depth_from_imu = shifted(0.05)
    depth_from_imu[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    bag.transform("/tf_static", 1, "camera_optical", "imu", depth_from_imu)
    stamps = [1_000_000_000 + 33_000_000 * number for number in range(4)]
    for number, (frame, stamp) in enumerate(zip(scenes(4), stamps, strict=True)):
        shown = [(9.8, 0.0, 0.0), (0.0, 0.0, 9.7), (30.0, 0.0, 0.0), (9.8, 0.0, 0.0)][number]
        vector = dict(zip("xyz", shown, strict=True))
        own_ns = stamp - (1_000_000 if number < 3 else 500_000_000)
        imu = {"header": header(own_ns, "imu"), "linear_acceleration": vector}
        bag.add("/camera/imu", IMU, imu, stamp - 1_000_000)
        camera = frame.calibration.depth
        bag.camera("/camera", frame, camera, stamp)
    with open_source(bag.close()) as source:
        found = [frame.gravity for frame in source]
    # Upward is its x, which is the depth camera's y.
    np.testing.assert_allclose(found[0], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(found[1], [0, 0, -1], atol=1e-12)
    # It was shaken, and at last silent.
    assert found[2:] == [None, None]
