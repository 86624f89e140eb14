"""Captures as nerfstudio, Polycam and COLMAP write them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_scene import scenes, write_image
from scipy.spatial.transform import Rotation

from nurbseg.drivers import CalibrationError, SourceOptions, open_source

CAMERA = {"fl_x": 52.5, "fl_y": 52.5, "cx": 31.5, "cy": 23.5, "w": 64, "h": 48}


def capture(folder: Path, order: list[int], whole: dict[str, Any], own: list[dict[str, Any]]) -> Path:
    """Write frames that are listed in an order; `own` is what each states besides its images."""
    frames: list[dict[str, Any]] = [{} for _ in order]
    for place, number in enumerate(order):
        frame = scenes(len(order))[number]
        names = f"images/frame_{number}.png", f"depth/frame_{number}.png"
        write_image(folder / names[0], frame.color)
        write_image(folder / names[1], frame.depth_mm)
        frames[place] = {"file_path": f"./{names[0]}", "depth_file_path": names[1]} | own[number]
    (folder / "transforms.json").write_text(json.dumps(whole | {"frames": frames}))
    return folder


def test_frames_are_in_the_order_of_their_names(tmp_path: Path) -> None:
    order = [2, 10, 0, 7, 1, 9, 3, 8, 4, 6, 5]
    with open_source(capture(tmp_path, order, CAMERA, [{}] * 11)) as source:
        for frame, expected in zip(source, scenes(11), strict=True):
            np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)


@pytest.mark.parametrize("is_given", [False, True])
def test_each_frame_may_have_a_camera_of_its_own(tmp_path: Path, is_given: bool) -> None:
    own = [CAMERA | {"fl_x": 52.5 + number} for number in range(3)]
    options = SourceOptions(intrinsics=(60.0, 60.0, 31.5, 23.5)) if is_given else None
    top = {"depth_unit_scale_factor": 0.0005}
    with open_source(capture(tmp_path, [0, 1, 2], top, own), options) as source:
        frames = list(source)
    assert [frame.calibration.depth.fx for frame in frames] == (
        [60.0] * 3 if is_given else [52.5, 53.5, 54.5]
    )
    np.testing.assert_array_equal(frames[0].depth_mm, np.rint(scenes(1)[0].depth_mm / 2))


def test_a_frame_without_a_camera_is_named(tmp_path: Path) -> None:
    folder = capture(tmp_path, [0, 1, 2], {}, [CAMERA, {}, CAMERA])
    with pytest.raises(CalibrationError, match=r"frames: '\./images/frame_1\.png': fl_x: missing"):
        open_source(folder)


def test_poses_are_those_of_cameras_that_look_along_minus_z(tmp_path: Path) -> None:
    turns = [Rotation.from_euler("xyz", (0.1 * number, 0.2, -0.3)) for number in range(3)]
    own = []
    for number, turn in enumerate(turns):
        rows = np.hstack([turn.as_matrix(), [[number], [1.5], [-0.2]]]).tolist()
        own.append({"transform_matrix": [*rows, [0, 0, 0, 1]]})
    own[2]["transform_matrix"] = [[1, 2], [3, 4]]
    own.append({"transform_matrix": [[10**400] * 4] * 4})
    with open_source(capture(tmp_path, [1, 0, 2, 3], CAMERA, own)) as source:
        poses = [frame.world_from_camera for frame in source]
    for number in (0, 1):
        # A point that is 2 m ahead of our camera, and 1 m below: z is backward and y up in theirs.
        seen = poses[number] @ [0, 1, 2, 1]
        place = np.array([number, 1.5, -0.2])
        np.testing.assert_allclose(seen[:3], place + turns[number].apply([0, -1, -2]))
    assert poses[2:] == [None, None]
    with open_source(capture(tmp_path, [0, 1, 2, 3], CAMERA | {"applied_scale": 0.3}, own)) as source:
        assert source.read().world_from_camera is None


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "OPENCV_FISHEYE"])
def test_a_projection_of_another_kind_is_refused_without_coefficients_too(tmp_path: Path, model: str) -> None:
    folder = capture(tmp_path, [0], CAMERA | {"camera_model": model, "k1": 0.0}, [{}])
    with pytest.raises(CalibrationError, match=rf"transforms\.json: distortion model: .*got '{model}'"):
        open_source(folder)


def keyframes(folder: Path, left_out: tuple[str, ...] = ()) -> tuple[Path, list[Rotation]]:
    """Write Polycam's raw data: color has four times as many rows as depth, and a camera that moves."""
    turns = [Rotation.from_euler("xyz", (0.1 * number, 0.2, -0.3)) for number in range(3)]
    for frame, turn in zip(scenes(3), turns, strict=True):
        name = f"{638_443_502_000 + frame.index * 1_000}"
        color = frame.color.repeat(4, axis=0).repeat(4, axis=1)
        write_image(folder / "images" / f"{name}.jpg", color)
        write_image(folder / "depth" / f"{name}.png", frame.depth_mm)
        write_image(folder / "confidence" / f"{name}.png", np.full((48, 64), 255, np.uint8))
        camera = {
            "fx": 210.0 + frame.index,
            "fy": 210.0,
            "cx": 127.5,
            "cy": 95.5,
            "width": 256,
            "height": 192,
        }
        rows = np.hstack([turn.as_matrix(), [[frame.index], [1.5], [-0.2]]])
        pose = {f"t_{row}{column}": rows[row, column] for row in range(3) for column in range(4)}
        stated = camera | pose | {"blur_score": 115.28, "center_depth": 1.2, "neighbors": []}
        (folder / "cameras").mkdir(exist_ok=True)
        kept = {key: value for key, value in stated.items() if key not in left_out}
        (folder / "cameras" / f"{name}.json").write_text(json.dumps(kept))
    return folder, turns


def test_polycams_raw_data_have_a_camera_and_a_pose_for_each_frame(tmp_path: Path) -> None:
    folder, turns = keyframes(tmp_path)
    with open_source(folder) as source:
        frames = list(source)
    assert [frame.calibration.color.fx for frame in frames] == [210.0, 211.0, 212.0]
    assert [frame.calibration.depth.fx for frame in frames] == [52.5, 52.75, 53.0]
    for frame, turn, expected in zip(frames, turns, scenes(3), strict=True):
        np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)
        seen = frame.world_from_camera @ [0, 1, 2, 1]
        np.testing.assert_allclose(seen[:3], np.array([frame.index, 1.5, -0.2]) + turn.apply([0, -1, -2]))


def test_polycams_raw_data_without_a_camera_or_pose(tmp_path: Path) -> None:
    folder, _ = keyframes(tmp_path / "a", ("t_12",))
    with open_source(folder) as source:
        assert [frame.world_from_camera for frame in source] == [None] * 3
    folder, _ = keyframes(tmp_path / "b", ("fy",))
    with pytest.raises(CalibrationError, match=r"cameras/638443502000\.json: fy: missing; expected pixels"):
        open_source(folder)


def turned(number: int) -> tuple[list[float], list[list[float]]]:
    """Return a position and a rotation about x, by the quaternion (0.6, 0, 0, 0.8)."""
    return [number + 0.25, -1.5, 2.0], [[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]]


def written_frames(folder: Path, color: str, depth: str, numbers: list[int]) -> None:
    for number in numbers:
        write_image(folder / color.format(number), scenes(number + 1)[number].color)
        write_image(folder / depth.format(number), scenes(number + 1)[number].depth_mm)


def poses(folder: Path) -> list[Any]:
    with open_source(folder, SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))) as source:
        return [frame.world_from_camera for frame in source]


@pytest.mark.parametrize("opened", [".", "results"])
def test_replicas_poses_are_the_lines_of_its_frames_numbers(tmp_path: Path, opened: str) -> None:
    written_frames(tmp_path / "results", "frame{:06}.jpg", "depth{:06}.png", [0, 2, 3])
    lines = []
    for number in range(3):
        place, turn = turned(number)
        rows = [[*row, at] for row, at in zip(turn, place, strict=True)]
        lines.append(" ".join(f"{value:e}" for row in [*rows, [0, 0, 0, 1]] for value in row))
    (tmp_path / "traj.txt").write_text("\n".join(lines))
    found = poses(tmp_path / opened)
    for pose, number in zip(found, (0, 2), strict=False):
        np.testing.assert_array_equal(pose[:3, 3], turned(number)[0])
        np.testing.assert_array_equal(pose[:3, :3], turned(number)[1])
    assert found[2] is None


@pytest.mark.parametrize("form", ["header", "camera", "bare"])
def test_stray_scanners_poses_are_those_of_its_frames_numbers(
    tmp_path: Path, form: str, caplog: pytest.LogCaptureFixture
) -> None:
    written_frames(tmp_path, "rgb/{:06}.jpg", "depth/{:06}.png", [0, 2])
    header = "timestamp, frame, x, y, z, qx, qy, qz, qw" + ", fx, fy, cx, cy" * (form == "camera")
    lines = [] if form == "bare" else [header]
    for number in range(3):
        pose = [*turned(number)[0], 0.6, 0.0, 0.0, 0.8]
        before = "" if form == "bare" else f"{100 + number / 60}, {number:06}, "
        lines.append(before + ", ".join(map(str, pose)) + ", 1, 2, 3, 4" * (form == "camera"))
    # Where a header says which frame is meant, the order does not matter.
    lines = lines if form == "bare" else [lines[0], *reversed(lines[1:]), "x, 1"]
    (tmp_path / "odometry.csv").write_text("\n".join(lines))
    for pose, number in zip(poses(tmp_path), (0, 2), strict=True):
        np.testing.assert_array_equal(pose[:3, 3], turned(number)[0])
        np.testing.assert_allclose(pose[:3, :3], turned(number)[1], atol=1e-12)
    assert ("1 lines are no pose" in caplog.text) == (form != "bare")
