"""Published data sets in the folders that are downloaded, as the tests write them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_scene import CAMERA, back_projected, scene, scenes, write_image, write_pcd
from scipy.spatial.transform import Rotation

from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers import CalibrationError, SourceOptions, open_source

VGA = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)


def read(folder: Path, options: SourceOptions | None = None):
    with open_source(folder, options) as source:
        return list(source), source


def numbers(camera: Intrinsics) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def seven_scenes(folder: Path) -> Path:
    for index, frame in enumerate(scenes(2, Calibration.registered(VGA))):
        stem = folder / f"frame-{index:06d}"
        write_image(Path(f"{stem}.color.png"), frame.color)
        write_image(Path(f"{stem}.depth.png"), np.where(frame.depth_mm == 0, 65535, frame.depth_mm))
        pose = np.eye(4)
        pose[:3, 3] = index, 2, 3
        Path(f"{stem}.pose.txt").write_text("\n".join(" \t ".join(f"{v:.7e}" for v in row) for row in pose))
    return folder


def test_7_scenes(tmp_path, caplog):
    frames, _ = read(seven_scenes(tmp_path / "chess" / "seq-01"))
    expected = scene(0, Calibration.registered(VGA)).depth_mm
    np.testing.assert_array_equal(frames[0].depth_mm, expected)
    assert numbers(frames[0].calibration.depth) == (585.0, 585.0, 320.0, 240.0)
    assert frames[1].world_from_camera[:3, 3].tolist() == [1, 2, 3]
    assert "whose camera is unknown" in caplog.text
    # What the user gives counts, and under any other name there is no camera.
    given, _ = read(tmp_path / "chess" / "seq-01", SourceOptions(intrinsics=numbers(VGA)))
    assert numbers(given[0].calibration.depth) == numbers(VGA)
    (tmp_path / "chess" / "seq-01").rename(tmp_path / "mine")
    with pytest.raises(CalibrationError, match="no calibration"):
        open_source(tmp_path / "mine")


@pytest.mark.parametrize("name", ["living_room_traj0_frei_png", "office_traj2_frei_png", "lr_kt3n"])
def test_icl_nuim(tmp_path, name):
    lines = []
    for index, frame in enumerate(scenes(3, Calibration.registered(VGA), labels=False)):
        write_image(tmp_path / name / "rgb" / f"{index}.png", frame.color)
        write_image(tmp_path / name / "depth" / f"{index}.png", frame.depth_mm * 5)
        lines.append(f"{index} depth/{index}.png {index} rgb/{index}.png")
    (tmp_path / name / "associations.txt").write_text("\n".join(lines))
    frames, source = read(tmp_path / name)
    assert len(frames) == 3
    # Its images run upwards.
    assert numbers(frames[0].calibration.depth) == (481.2, -480.0, 319.5, 239.5)
    np.testing.assert_array_equal(frames[0].depth_mm, scene(0, Calibration.registered(VGA)).depth_mm)
    assert str(source.depth_unit) == "5000 per meter (TUM RGB-D's own)"


def test_poses_of_icl_nuim_are_by_number_and_of_images_that_run_upward(tmp_path):
    """Points of a world that two frames see are the same, whichever way the user has the images run."""
    folder = tmp_path / "living_room_traj0_frei_png"
    rng = np.random.default_rng(0)
    world = rng.uniform(-0.3, 0.3, (5, 3)) + np.array([0.0, 0.0, 2.0])
    turns = Rotation.from_euler("yxz", [[0.1, -0.2, 0.3], [-0.2, 0.1, 0.0]])
    shifts = np.array([[0.1, 0.2, 0.0], [-0.1, 0.1, 0.2]])
    listed, seen = [], []
    for n in range(2):
        x, y, z = turns[n].inv().apply(world - shifts[n]).T
        # An image that runs upward: its rows are counted from the bottom by a focal length below 0.
        seen.append(np.stack([481.2 * x / z + 319.5, -480.0 * y / z + 239.5, z], axis=1))
        listed.append([n + 1, *shifts[n], *turns[n].as_quat()])
        write_image(folder / "rgb" / f"{n + 1}.png", np.zeros((480, 640, 3), np.uint8))
        write_image(folder / "depth" / f"{n + 1}.png", np.full((480, 640), 5000, np.uint16))
    lines = [f"{n} depth/{n}.png {n} rgb/{n}.png" for n in (1, 2)]
    (folder / "associations.txt").write_text("\n".join(lines))
    rows = [" ".join(map(str, row)) for row in [*listed, [40, 9, 9, 9, 0, 0, 0, 1]]]
    (folder / "livingRoom0.gt.freiburg").write_text("\n".join(rows))
    for options in (SourceOptions(), SourceOptions(intrinsics=(481.2, 480.0, 319.5, 239.5))):
        frames, _ = read(folder, options)
        found = []
        for frame, (u, v, z) in zip(frames, (each.T for each in seen), strict=True):
            _, fy, *_ = numbers(frame.calibration.depth)
            points = np.stack([(u - 319.5) / 481.2 * z, (v - 239.5) / fy * z, z, np.ones(5)])
            found.append((frame.world_from_camera @ points)[:3].T)
        np.testing.assert_allclose(found[0], found[1], atol=1e-9)
        np.testing.assert_allclose(found[0], world * (1, np.sign(-fy), 1), atol=1e-9)


def ocid(folder: Path) -> Path:
    for frame in scenes(3):
        name = f"result_2018-08-21-10-44-3{frame.index}"
        write_image(folder / "rgb" / f"{name}.png", frame.color)
        write_image(folder / "depth" / f"{name}.png", frame.depth_mm)
        write_image(folder / "label" / f"{name}.png", frame.labels)
        write_pcd(folder / "pcd" / f"{name}.pcd", back_projected(frame), frame.color, "binary")
    return folder


def test_ocid_has_the_camera_of_its_clouds_and_labels(tmp_path):
    frames, source = read(ocid(tmp_path / "ARID20" / "table" / "top" / "seq01"))
    assert [frame.name for frame in frames] == [f"result_2018-08-21-10-44-3{n}" for n in range(3)]
    np.testing.assert_allclose(numbers(frames[0].calibration.depth), numbers(CAMERA), rtol=1e-4)
    np.testing.assert_array_equal(frames[1].labels, scene(1).labels)
    assert source.metadata["calibration"].endswith(".pcd")


def test_clouds_that_show_no_camera_are_none(tmp_path, caplog):
    folder = ocid(tmp_path / "seq01")
    path = min((folder / "pcd").iterdir())
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(CalibrationError, match="no calibration"):
        open_source(folder)
    assert path.name in caplog.text


DEPTH = Intrinsics(64, 48, 57.6, 57.6, 31.5, 23.1)
COLOR = Intrinsics(130, 97, 116.0, 116.2, 64.0, 48.0)
APART = Calibration(DEPTH, COLOR)


def scannet(folder: Path, labels: str = "instance") -> Path:
    for index, frame in enumerate(scenes(2, APART)):
        write_image(folder / "color" / f"{index}.jpg", frame.color)
        write_image(folder / "depth" / f"{index}.png", frame.depth_mm)
        write_image(folder / labels / f"{index}.png", color_labels(index))
        # What kind of thing it is, beside which it is.
        write_image(folder / "label" / f"{index}.png", np.full((97, 130), 40, np.uint16))
        (folder / "pose").mkdir(exist_ok=True)
        (folder / "pose" / f"{index}.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 5\n0 0 0 1\n")
    for name, camera in (("depth", DEPTH), ("color", COLOR)):
        rows = np.eye(4)
        rows[:3, :3] = camera.matrix
        (folder / f"intrinsics_{name}.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    return folder


def color_labels(index: int) -> np.ndarray:
    labels = np.full((97, 130), 3, np.uint16)
    labels[20:60, 40 + index : 90] = 5001
    return labels


@pytest.mark.parametrize("name", ["instance", "instance-filt"])
def test_labels_of_scannets_color_are_those_of_the_depth_pixels_that_show_the_same(tmp_path, name):
    frames, _ = read(scannet(tmp_path / "scene0000_00", name))
    for frame in frames:
        expected = np.zeros((48, 64), np.uint16)
        for v, u in np.argwhere(frame.depth_mm > 0):
            column = round((u - DEPTH.cx) / DEPTH.fx * COLOR.fx + COLOR.cx)
            row = round((v - DEPTH.cy) / DEPTH.fy * COLOR.fy + COLOR.cy)
            if 0 <= column < 130 and 0 <= row < 97:
                expected[v, u] = color_labels(frame.index)[row, column]
        np.testing.assert_array_equal(frame.labels, expected)
        assert set(np.unique(frame.labels)) == {0, 3, 5001}
        assert frame.world_from_camera[2, 3] == 5


def test_labels_of_cameras_apart_move_with_depth():
    from nurbseg.drivers.datasets.published import _on_depth

    step = np.eye(4)
    step[0, 3] = 0.06
    camera = replace(CAMERA, distortion=np.zeros(0))
    labels = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64)
    for depth_mm in (525, 1050):
        moved = _on_depth(labels, np.full((48, 64), depth_mm, np.uint16), Calibration(camera, camera, step))
        shift = round(52.5 * 0.06 * 1000 / depth_mm)
        np.testing.assert_array_equal(moved[:, : 64 - shift], labels[:, shift:])
        assert not moved[:, 64 - shift :].any()
    assert not _on_depth(labels, np.zeros((48, 64), np.uint16), Calibration(camera, camera, step)).any()


def test_the_evaluation_scores_with_its_labels(tmp_path):
    folder = ocid(tmp_path / "seq01")
    command = [
        str(Path(sys.executable).with_name("nurbseg-eval")),
        "run",
        str(folder),
        "--out",
        str(tmp_path / "o"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert "3 frames" in done.stdout + done.stderr
