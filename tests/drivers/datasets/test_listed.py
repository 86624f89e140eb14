"""Recordings in the layouts of other programs: their units, cameras and pairs are those that they state."""

import json
from pathlib import Path

import numpy as np
import pytest
from recorded_scene import scene, write_image

from nurbseg.drivers import CalibrationError, DriverError, RecordingFormatError, SourceOptions, open_source

K = (52.5, 52.5, 31.5, 23.5)
GIVEN = SourceOptions(intrinsics=K)


def write(folder: Path, number: int, factor: float, color: str, depth: str) -> None:
    """Write a pair whose depth has this many units per millimeter."""
    write_image(folder / color, scene(number).color)
    write_image(folder / depth, np.rint(scene(number).depth_mm * factor).astype(np.uint16))


def test_a_bop_scene_has_a_camera_and_a_unit_for_each_image(tmp_path: Path) -> None:
    index = {}
    for number in (0, 1):
        write(tmp_path, number, 10, f"rgb/{number:06d}.png", f"depth/{number:06d}.png")
        index[str(number)] = {"cam_K": [50 + number, 0, 31, 0, 51, 23, 0, 0, 1], "depth_scale": 0.1}
    (tmp_path / "scene_camera.json").write_text(json.dumps(index))
    with open_source(tmp_path) as source:
        frames = [source.read(), source.read()]
        assert source.metadata["depth_unit"].startswith("10000 per meter (scene_camera.json: depth_scale 0.1")
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)
        assert frame.calibration.depth.fx == 50 + number
    with open_source(tmp_path, SourceOptions(intrinsics=K, depth_scale=5000)) as source:
        np.testing.assert_array_equal(source.read().depth_mm, scene(0).depth_mm.astype(int) * 2)
    del index["1"]
    (tmp_path / "scene_camera.json").write_text(json.dumps(index))
    with pytest.raises(CalibrationError, match=r"1\.cam_K: expected 9 numbers"):
        open_source(tmp_path)


def test_what_came_before_a_bop_scene_has_its_cameras_units_and_poses(tmp_path: Path) -> None:
    lines = []
    for number in (0, 11):
        write(tmp_path, number, 10, f"rgb/{number:04d}.png", f"depth/{number:04d}.png")
        camera = f"cam_K: [5{number}.0, 0.0, 31.0, 0.0, 51.0, 23.0, 0.0, 0.0, 1.0]"
        pose = "cam_R_w2c: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n  cam_t_w2c: [0.0, 0.0, 500.0]"
        lines.append(f"{number}:\n  {camera}\n  {pose}\n  depth_scale: 0.1\n")
    (tmp_path / "info.yml").write_text("".join(lines))
    for options in (SourceOptions(), GIVEN):
        with open_source(tmp_path, options) as source:
            frames = list(source)
        for number, frame in zip((0, 11), frames, strict=True):
            np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)
            assert frame.calibration.depth.fx == (52.5 if options is GIVEN else float(f"5{number}"))
            assert frame.world_from_camera is not None and frame.world_from_camera[2, 3] == -0.5
    for damaged in (b"0:\n  cam_K: [", b"0:\n  cam_K: [1]\nname: \xff\n"):
        (tmp_path / "info.yml").write_bytes(damaged)
        with pytest.raises(RecordingFormatError, match=r"info\.yml: not valid YML"):
            open_source(tmp_path)
    (tmp_path / "info.yml").write_text("name: kitchen\n")
    with open_source(tmp_path, GIVEN) as source:
        assert source.metadata["format"] == "folder of image pairs"


def bop_scene(folder: Path, numbers: tuple[int, ...] = (3, 7)) -> dict[str, dict[str, object]]:
    index: dict[str, dict[str, object]] = {}
    for number in numbers:
        write(folder, number, 1, f"rgb/{number:06d}.png", f"depth/{number:06d}.png")
        index[str(number)] = {"cam_K": [50, 0, 31, 0, 51, 23, 0, 0, 1], "depth_scale": 1.0}
    (folder / "scene_camera.json").write_text(json.dumps(index))
    return index


def test_a_bop_scene_has_the_visible_masks_of_its_objects_as_labels(tmp_path: Path) -> None:
    bop_scene(tmp_path)
    expected = np.zeros(scene(3).depth_mm.shape, np.uint16)
    for number, rows in ((0, slice(5, 9)), (1, slice(20, 30)), (11, slice(31, 33))):
        mask = np.zeros(expected.shape, np.uint8)
        mask[rows, 7:40] = 255
        write_image(tmp_path / f"mask_visib/000003_{number:06d}.png", mask)
        expected[rows, 7:40] = number + 1
    # The whole of an object, also where it is hidden, is not read.
    write_image(tmp_path / "mask/000003_000000.png", np.full(expected.shape, 255, np.uint8))
    with open_source(tmp_path) as source:
        first, second = source
    np.testing.assert_array_equal(first.labels, expected)
    assert second.labels is None


@pytest.mark.parametrize("content", [b"", b"no image", None])
def test_a_mask_that_is_unusable_costs_the_labels_of_its_frame(tmp_path: Path, content: bytes | None) -> None:
    bop_scene(tmp_path)
    shape = scene(3).depth_mm.shape
    for number in (3, 7):
        write_image(tmp_path / f"mask_visib/{number:06d}_000000.png", np.full(shape, 255, np.uint8))
    bad = tmp_path / "mask_visib/000003_000001.png"
    if content is None:
        write_image(bad, np.full((5, 5), 255, np.uint8))
    else:
        bad.write_bytes(content)
    with open_source(tmp_path) as source:
        first, second = source
        assert source.metadata["unusable_labels"] == "1"
    assert first.labels is None
    assert second.labels is not None
    assert (second.labels == 1).all()


def test_a_bop_scene_has_the_poses_that_are_stated(tmp_path: Path) -> None:
    index = bop_scene(tmp_path, (3, 7, 8, 9))
    index["3"] |= {"cam_R_w2c": [0, -1, 0, 1, 0, 0, 0, 0, 1], "cam_t_w2c": [100, 200, 300]}
    index["7"] |= {"cam_R_w2c": [2, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_w2c": [0, 0, 0]}
    index["9"] |= {"cam_R_w2c": [10**400] * 9, "cam_t_w2c": [0, 0, 0]}
    (tmp_path / "scene_camera.json").write_text(json.dumps(index))
    with open_source(tmp_path) as source:
        poses = [frame.world_from_camera for frame in source]
    # A point of the world goes to the camera by p' = R p + t.
    point = np.array([0.5, -0.25, 2.0])
    seen = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ point + [0.1, 0.2, 0.3]
    assert poses[0] is not None
    np.testing.assert_allclose((poses[0] @ [*seen, 1])[:3], point, atol=1e-12)
    assert poses[1:] == [None, None, None]


def test_transforms_json_lists_pairs_their_camera_and_unit(tmp_path: Path) -> None:
    write(tmp_path, 0, 4, "images/a.png", "depths/b.png")
    table = {
        "fl_x": 52.5,
        "fl_y": 52.5,
        "cx": 31.5,
        "cy": 23.5,
        "w": 64,
        "h": 48,
        "depth_unit_scale_factor": 0.00025,
        "frames": [{"file_path": "images/a.png", "depth_file_path": "depths/b.png"}],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    with open_source(tmp_path) as source:
        frame = source.read()
    np.testing.assert_array_equal(frame.depth_mm, scene(0).depth_mm)
    np.testing.assert_array_equal(frame.color, scene(0).color)
    table["frames"][0]["file_path"] = "../a.png"
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    with pytest.raises(RecordingFormatError, match="outside the folder"):
        open_source(tmp_path)


def test_other_images_that_begin_with_d_and_r_are_not_taken_for_libfreenects(tmp_path: Path) -> None:
    # Its times have six decimals.
    write_image(tmp_path / "d-1316653580.5-1.pgm", np.full((48, 64), 900, dtype=np.uint16))
    write_image(tmp_path / "r-1316653580.5-1.ppm", scene(1).color)
    with pytest.raises(DriverError) as caught:
        open_source(tmp_path)
    assert "taken at the same time" not in str(caught.value)


def test_libfreenects_recording_is_disparity_paired_by_the_hosts_time(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    disparity = np.full((48, 64), 700, np.uint16)
    disparity[:5] = 2047
    for tick, (d, r) in enumerate([(471513, 480000), (504900, 512000)]):
        write_image(tmp_path / f"d-1316653580.{d}-{tick}.pgm", disparity.byteswap())
        write_image(tmp_path / f"r-1316653580.{r}-{tick}.ppm", scene(tick).color)
    (tmp_path / "INDEX.txt").write_text("d-1316653580.471513-0.pgm\n")
    with open_source(tmp_path, GIVEN) as source:
        frames = [source.read(), source.read()]
    assert [frame.timestamp_ns for frame in frames] == [1316653580471513000, 1316653580504900000]
    for tick, frame in enumerate(frames):
        assert frame.depth_mm[0, 0] == 0
        assert frame.depth_mm[20, 0] == round(351_300 / (1092.5 - 700))
        np.testing.assert_array_equal(frame.color, scene(tick).color)
    assert "not registered to color" in caplog.text


@pytest.mark.parametrize("line", ["{0} depth/{0}.png {0} rgb/{0}.png", "{0} rgb/{0}.png {0} depth/{0}.png"])
def test_a_list_of_pairs_has_tums_unit(tmp_path: Path, line: str) -> None:
    for number in (0, 1):
        write(tmp_path, number, 5, f"rgb/{number}.png", f"depth/{number}.png")
    (tmp_path / "associations.txt").write_text("\ufeff" + "\r\n".join(line.format(n) for n in (0, 1)))
    with open_source(tmp_path, GIVEN) as source:
        frames = [source.read(), source.read()]
        assert source.metadata["depth_unit"] == "5000 per meter (TUM RGB-D's own)"
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)
        np.testing.assert_array_equal(frame.color, scene(number).color)
        assert frame.timestamp_ns == number * 33_333_333


def test_scannets_two_cameras_are_used(tmp_path: Path) -> None:
    write(tmp_path, 0, 1, "color/0.png", "depth/0.png")
    folder = tmp_path / "intrinsic"
    folder.mkdir()
    for name, focal in (("depth", 52.5), ("color", 60.0)):
        (folder / f"intrinsic_{name}.txt").write_text(
            f"{focal} 0 31.5 0\n0 {focal} 23.5 0\n0 0 1 0\n0 0 0 1\n"
        )
        step = 0.02 if name == "color" else 0.0
        (folder / f"extrinsic_{name}.txt").write_text(f"1 0 0 {step}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    with open_source(tmp_path) as source:
        calibration = source.calibration
    assert (calibration.depth.fx, calibration.color.fx) == (52.5, 60.0)
    # What is at the depth camera's origin is 2 cm to the left of the color camera.
    np.testing.assert_allclose(calibration.color_from_depth[:3, 3], [-0.02, 0, 0])


@pytest.mark.parametrize("name", ["data/../info.txt", "data/info.txt", "data/_info.txt"])
def test_the_description_of_a_sens_file_is_used_as_12_scenes_and_bundlefusion_have_it(
    tmp_path: Path, name: str
) -> None:
    write(tmp_path / "data", 1, 4, "frame-000001.color.png", "frame-000001.depth.png")
    lines = ["m_depthShift = 4000"]
    for word, fx in (("Color", 50), ("Depth", 60)):
        lines.append(f"m_calibration{word}Intrinsic = {fx} 0 31 0 0 51 23 0 0 0 1 0 0 0 0 1")
    (tmp_path / name).write_text("\n".join(lines))
    with open_source(tmp_path / "data") as source:
        frame = source.read()
    assert (frame.calibration.depth.fx, frame.calibration.color.fx) == (60, 50)
    np.testing.assert_array_equal(frame.depth_mm, scene(1).depth_mm)


def test_stray_scanners_matrix_is_that_of_its_video(tmp_path: Path) -> None:
    write_image(tmp_path / "depth/000000.png", scene(0).depth_mm)
    (tmp_path / "camera_matrix.csv").write_text("1600.0, 0.0, 959.5\n0.0, 1600.0, 719.5\n0.0, 0.0, 1.0\n")
    (tmp_path / "rgb.mp4").write_bytes(b"x")
    with open_source(tmp_path) as source:
        camera = source.calibration.depth
    assert camera.fx == pytest.approx(1600 * 64 / 1920)
    assert camera.cx == pytest.approx(31.5)
