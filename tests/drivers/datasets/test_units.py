"""The unit of a folder's depth: what is given, stated, usual or told by the values; and what is doubted."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded_scene import scene, write_image

from nurbseg.drivers import FrameFormatError, SourceOptions, open_source
from nurbseg.drivers.datasets.images import decode_stored

K = (52.5, 52.5, 31.5, 23.5)
GIVEN = SourceOptions(intrinsics=K)
#: Everything nearer than 2.05 m, where rotated millimeters have no bit at their end.
NEAR_MM = (scene(0).depth_mm // 2).astype(np.uint16)


def rotated(depth_mm: np.ndarray) -> np.ndarray:
    """Return millimeters rotated left by three bits."""
    wide = depth_mm.astype(np.uint32) << 3
    return ((wide & 0xFFFF) | (wide >> 16)).astype(np.uint16)


def write(folder: Path, *depths: np.ndarray, extension: str = "png") -> Path:
    """Write depth images, and color for each."""
    for number, depth in enumerate(depths):
        write_image(folder / f"{number}_color.png", scene(0).color)
        write_image(folder / f"{number}_depth.{extension}", depth)
    return folder


def read(folder: Path, options: SourceOptions = GIVEN) -> tuple[list[np.ndarray], str]:
    """Return the depth of all frames, and the unit it was read in."""
    with open_source(folder, options) as source:
        assert source.metadata["depth_unit"] == str(source.depth_unit)
        return [frame.depth_mm for frame in source], str(source.depth_unit)


def test_near_frames_of_sun_rgbd_are_rotated_as_far_ones_are(tmp_path: Path) -> None:
    far_mm = np.where(scene(1).depth_mm > 0, scene(1).depth_mm * 4 + 1, 0).astype(np.uint16)
    assert (rotated(NEAR_MM) & 7 == 0).all()
    assert far_mm.max() > 8192
    for name, depths in {"near": [NEAR_MM], "both": [NEAR_MM, far_mm], "far": [far_mm]}.items():
        found, unit = read(write(tmp_path / name, *map(rotated, depths)))
        for one, expected in zip(found, depths, strict=True):
            np.testing.assert_array_equal(one, expected)
        assert unit == "millimeters rotated by three bits (all values are multiples of 8, as in SUN RGB-D)"


def test_the_user_counts_before_what_the_values_look_like(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write(tmp_path, rotated(NEAR_MM))
    (found,), unit = read(folder, SourceOptions(intrinsics=K, depth_scale=1000))
    np.testing.assert_array_equal(found, rotated(NEAR_MM))
    assert unit.startswith("1000 per meter (--depth-scale, against millimeters rotated")
    assert "--depth-scale 1000 counts, though the recording states millimeters rotated" in caplog.text


def test_a_stated_unit_counts_before_what_the_values_look_like(tmp_path: Path) -> None:
    stored = (scene(0).depth_mm * 8).astype(np.uint16)
    (write(tmp_path, stored) / "config.json").write_text('{"depth_scale": 8000}')
    (found,), unit = read(tmp_path)
    np.testing.assert_array_equal(found, scene(0).depth_mm)
    assert unit.startswith("8000 per meter (config.json")


@pytest.mark.parametrize(
    "depth",
    [
        # A rendered room of a few walls.
        np.repeat(np.arange(1000, 3000, 250, dtype=np.uint16), 384).reshape(48, 64) // 8 * 8,
        # The same, far enough for the bits of its values to be those of rotated ones.
        np.repeat(np.arange(16000, 32000, 2000, dtype=np.uint16), 384).reshape(48, 64),
        # 8 bits scaled up.
        (np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) % 200 + 10) * 16,
    ],
    ids=["walls", "far walls", "8 bits"],
)
def test_what_only_resembles_rotated_millimeters_is_read_as_it_is(tmp_path: Path, depth: np.ndarray) -> None:
    (found,), unit = read(write(tmp_path, depth))
    np.testing.assert_array_equal(found, depth)
    assert unit == "1000 per meter (whole numbers are in millimeters)"


@pytest.mark.parametrize("sign", ["depth_bfx", "annotation2Dfinal"])
def test_a_folder_of_sun_rgbd_is_known_by_what_else_is_in_it(tmp_path: Path, sign: str) -> None:
    walls = np.where(NEAR_MM > 800, np.uint16(1200), np.uint16(700))
    (tmp_path / sign).mkdir()
    (found,), unit = read(write(tmp_path, rotated(walls)))
    np.testing.assert_array_equal(found, walls)
    assert "SUN RGB-D's own" in unit


@pytest.mark.parametrize(
    ("beside", "content", "per_metre"),
    [
        # associate.py, and ICL-NUIM: pairs are found by folders here, the unit by the list beside them.
        ("groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n", 5000),
        ("config.json", {"depth_scale": 5000, "name": "x"}, 5000),
        ("metadata.json", {"depth_scale": 0.00025, "device": "D405"}, 4000),
        ("info.json", {"camera": {"depth_scale": 0.0001}}, 10_000),
        # Redwood's reconstruction, Replica as NICE-SLAM has it, BOP's camera.json, nerfstudio, instant-ngp.
        (
            "camera_intrinsic.json",
            {"intrinsic_matrix": [1, 0, 0, 0, 1, 0, 31, 23, 1], "depth_scale": 1000},
            1000,
        ),
        ("cam_params.json", {"camera": {"fx": 1, "fy": 1, "cx": 31, "cy": 23, "scale": 6553.5}}, 6553.5),
        ("camera.json", {"fx": 1, "fy": 1, "cx": 31, "cy": 23, "depth_scale": 0.1}, 10_000),
        ("transforms.json", {"fl_x": 1, "fl_y": 1, "cx": 31, "cy": 23, "integer_depth_scale": 0.00025}, 4000),
        ("_info.txt", "m_versionNumber = 4\nm_depthShift = 5000\n", 5000),
        (
            "calib.yaml",
            "%YAML:1.0\nCamera.fx: 1\nCamera.fy: 1\nCamera.cx: 31\nCamera.cy: 23\nDepthMapFactor: 5208.\n",
            5208,
        ),
        (
            "TUM3.yaml",
            "%YAML:1.0\nCamera.fx: 1\nCamera.fy: 1\nCamera.cx: 31\nCamera.cy: 23\nDepthMapFactor: 5208.\n",
            5208,
        ),
    ],
)
def test_the_factor_beside_the_images_counts_though_the_user_gives_the_camera(
    tmp_path: Path, beside: str, content: str | dict, per_metre: float
) -> None:
    depth_mm = scene(0).depth_mm
    stored = np.rint(depth_mm * (per_metre / 1000)).astype(np.uint16)
    write_image(tmp_path / "rgb/7.png", scene(0).color)
    write_image(tmp_path / "depth/7.png", stored)
    (tmp_path / beside).write_text(content if isinstance(content, str) else json.dumps(content))
    (found,), unit = read(tmp_path)
    np.testing.assert_allclose(found.astype(int), depth_mm, atol=1)
    assert unit.startswith(f"{per_metre:g} per meter (") and "--depth" not in unit
    (found,), unit = read(tmp_path, SourceOptions(intrinsics=K, depth_scale=2000))
    np.testing.assert_allclose(found, stored / 2, atol=1)
    assert unit.startswith("2000 per meter (--depth-scale")


def test_two_factors_that_differ_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, scene(0).depth_mm)
    (tmp_path / "camera.toml").write_text(
        "registered = true\ndepth_scale = 1000\n[color]\nfx = 52\nfy = 52\ncx = 31\ncy = 23\n"
    )
    (tmp_path / "config.json").write_text('{"depth_scale": 5000}')
    (found,), _ = read(tmp_path)
    np.testing.assert_array_equal(found, scene(0).depth_mm)
    assert "the first counts of two units that differ" in caplog.text
    assert "camera.toml" in caplog.text and "config.json" in caplog.text


def test_two_cameras_that_differ_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, scene(0).depth_mm)
    for name, fx in (("intrinsics.txt", 50), ("camera.yaml", 50.5), ("K.txt", 60)):
        text = f"fx: {fx}\nfy: {fx}\ncx: 31\ncy: 23\n" if "yaml" in name else f"{fx} 0 31\n0 {fx} 23\n0 0 1\n"
        (tmp_path / name).write_text(text)
    with open_source(tmp_path) as source:
        assert source.calibration.depth.fx == 50
    (said,) = caplog.messages
    assert "the first counts of two cameras that differ" in said and "K.txt" in said
    caplog.clear()
    read(tmp_path)
    assert not caplog.messages


def test_a_broken_file_beside_the_images_costs_nothing_that_the_user_gives(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, scene(0).depth_mm)
    (tmp_path / "calib.xml").write_text("<rgb><depth>")
    assert read(tmp_path)[0][0].any()
    assert "calib.xml: not valid XML" in caplog.text and "not needed" in caplog.text


def test_matterports_images_are_known_by_their_names(tmp_path: Path) -> None:
    name = "0123456789abcdef0123456789abcdef_{}1_2.png"
    write_image(tmp_path / "color" / name.format("d"), scene(0).color)
    write_image(tmp_path / "depth" / name.format("d"), scene(0).depth_mm * 4)
    (found,), unit = read(tmp_path)
    np.testing.assert_array_equal(found, scene(0).depth_mm)
    assert unit == "4000 per meter (Matterport3D's own)"


@pytest.mark.parametrize(
    ("color", "depth", "beside", "per_metre", "whose"),
    [
        ("000001-color.png", "000001-depth.png", "000001-meta.mat", 10_000, "YCB-Video"),
        ("000000.left.jpg", "000000.left.depth.png", "_object_settings.json", 10_000, "Falling Things"),
        ("point_7_view_0_domain_rgb.png", "point_7_view_0_domain_depth_zbuffer.png", "a", 512, "Taskonomy"),
    ],
)
def test_the_unit_of_a_data_set_is_known_by_its_files(
    tmp_path: Path, color: str, depth: str, beside: str, per_metre: int, whose: str
) -> None:
    write_image(tmp_path / color, scene(0).color)
    write_image(tmp_path / depth, np.rint(scene(0).depth_mm * (per_metre / 1000)).astype(np.uint16))
    (tmp_path / beside).touch()
    with open_source(f"images:?color={tmp_path / color}&depth={tmp_path / depth}", GIVEN) as source:
        assert whose in str(source.depth_unit)
        assert np.abs(source.read().depth_mm.astype(int) - scene(0).depth_mm).max() <= 1


@pytest.mark.parametrize("form", ["tiff", "npy"])
def test_floating_point_millimeters_need_the_flag_which_the_warning_names(
    tmp_path: Path, form: str, caplog: pytest.LogCaptureFixture
) -> None:
    meters = (scene(0).depth_mm / 1000).astype(np.float32)
    for name, depth in (("m", meters), ("mm", meters * 1000)):
        folder = tmp_path / name
        write_image(folder / "a_color.png", scene(0).color)
        if form == "tiff":
            write_image(folder / "a_depth.tiff", depth)
        else:
            np.save(folder / "a_depth.npy", depth)
    assert (read(tmp_path / "m")[0][0] == scene(0).depth_mm).all()
    assert caplog.text == ""
    read(tmp_path / "mm")
    assert "the nearest depth is 900 m" in caplog.text and "give --depth-scale" in caplog.text
    (found,), unit = read(tmp_path / "mm", SourceOptions(intrinsics=K, depth_scale=1000))
    np.testing.assert_array_equal(found, scene(0).depth_mm)
    assert unit == "1000 per meter (--depth-scale)"


def test_a_factor_for_16_bits_does_not_count_for_metres_beside_it(tmp_path: Path) -> None:
    write(tmp_path, (scene(0).depth_mm / 1000).astype(np.float32), extension="tiff")
    (tmp_path / "config.json").write_text('{"depth_scale": 1000}')
    np.testing.assert_array_equal(read(tmp_path)[0][0], scene(0).depth_mm)


@pytest.mark.parametrize(
    ("depth", "text"),
    [
        (scene(0).depth_mm * 7, "beyond"),
        (scene(0).depth_mm // 20, "nearer than"),
        (np.arange(3072, dtype=np.uint16).reshape(48, 64) % 36 * 257, "a multiple of 257 mm"),
    ],
    ids=["far", "near", "8 bits"],
)
def test_implausible_depth_is_one_warning_that_names_the_flag(
    tmp_path: Path, depth: np.ndarray, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    read(write(tmp_path, *[depth] * 4))
    doubted = [line for line in caplog.messages if "give --depth-scale" in line]
    assert len(doubted) == 1
    assert text in doubted[0] and "1000 per meter (whole" in doubted[0]


@pytest.mark.parametrize("scale", [0.001, 0.00025, 1])
def test_a_unit_in_meters_that_leaves_no_depth_is_doubted(
    tmp_path: Path, scale: float, caplog: pytest.LogCaptureFixture
) -> None:
    # As RealSense states it; ours are units per meter.
    (depth_mm,), _ = read(write(tmp_path, scene(0).depth_mm), SourceOptions(intrinsics=K, depth_scale=scale))
    assert not depth_mm.any()
    (said,) = caplog.messages
    assert "no pixel has depth of up to 65 m" in said and "give --depth-scale, units per meter" in said


def test_plausible_depth_is_not_doubted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    read(write(tmp_path, scene(0).depth_mm, NEAR_MM))
    assert caplog.text == ""


@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<i4", "<f2", "<f4", ">f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_that_numpy_saved_are_depth(tmp_path: Path, dtype: str, order: str) -> None:
    depth_mm = scene(0).depth_mm
    values = depth_mm / 1000 if dtype[1] == "f" else depth_mm
    write_image(tmp_path / "a_color.png", scene(0).color)
    # A channel of its own, as DIODE has.
    np.save(tmp_path / "a_depth.npy", np.asarray(values, dtype, order=order)[..., None])
    (found,), _ = read(tmp_path)
    np.testing.assert_allclose(found.astype(int), depth_mm, atol=1 if dtype == "<f2" else 0)


def npy(array: np.ndarray, folder: Path) -> bytes:
    np.save(folder / "x.npy", array, allow_pickle=True)
    return (folder / "x.npy").read_bytes()


@pytest.mark.parametrize(
    ("array", "text"),
    [
        (np.zeros((4, 4), np.uint8), "expected depth of 16 bits"),
        (np.array([[{}]], object), "expected depth of 16 bits"),
        (np.zeros((2, 4, 4), np.uint16), r"expected one image .* \(2, 4, 4\)"),
    ],
)
def test_arrays_that_are_no_depth_image_are_refused(tmp_path: Path, array: np.ndarray, text: str) -> None:
    with pytest.raises(FrameFormatError, match=text):
        decode_stored(npy(array, tmp_path), "a")


def test_an_array_that_is_cut_off_or_declares_too_much_is_refused(tmp_path: Path) -> None:
    content = npy(np.ones((48, 64), np.uint16), tmp_path)
    for end in (4, 9, 60, len(content) - 1):
        with pytest.raises(FrameFormatError, match=r"^a: "):
            decode_stored(content[:end], "a")
    larger = content.replace(b"(48, 64), }" + b" " * 9, b"(480000, 6400000), }")
    assert larger != content
    with pytest.raises(FrameFormatError, match="pixels at most"):
        decode_stored(larger, "a")


def test_raw_disparity_of_a_kinect_in_swapped_pgm_becomes_depth(tmp_path: Path) -> None:
    disparity = np.full((48, 64), 2047, np.uint16)
    disparity[10:20] = 700
    disparity[20:30] = 1050
    disparity[30:40] = 1090
    write(tmp_path, disparity.byteswap(), extension="pgm")
    # They have no unit, so that no factor applies.
    for options in (GIVEN, SourceOptions(intrinsics=K, depth_scale=5000)):
        (depth_mm,), unit = read(tmp_path, options)
        assert depth_mm[0, 0] == 0
        assert depth_mm[15, 0] == round(351_300 / (1092.5 - 700))
        assert depth_mm[25, 0] == round(351_300 / (1092.5 - 1050))
        # Farther than the sensor measures.
        assert depth_mm[35, 0] == 0
        assert unit.startswith("11-bit disparity (a Kinect's")


def test_signed_16_bits_are_depth() -> None:
    depth = np.array([[-1, 0, 1500]], np.int16)
    content = cv2.imencode(".tiff", depth)[1].tobytes()
    np.testing.assert_array_equal(decode_stored(content, "a"), depth)


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_depth_along_an_axis_that_points_backwards_is_said(
    tmp_path: Path, dtype: type, caplog: pytest.LogCaptureFixture
) -> None:
    write_image(tmp_path / "a_color.png", scene(0).color)
    np.save(tmp_path / "a_depth.npy", -scene(0).depth_mm.astype(dtype))
    assert not read(tmp_path)[0][0].any()
    assert "all depth is negative" in caplog.text
