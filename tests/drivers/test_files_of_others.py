"""Files as other programs and systems leave them: stray files, other units, layouts and encodings."""

from pathlib import Path

import numpy as np
import pytest
from recorded_scene import CAMERA, back_projected, scene, write_image, write_pcd
from robot_bag import Bag

from nurbseg.drivers import SourceOptions, open_source

K = (52.5, 52.5, 31.5, 23.5)
GIVEN = SourceOptions(intrinsics=K)
FRAME = scene(0)
STAMP = 1_700_000_000_000_000_000
#: Of color, as cameras' drivers publish it.
ENCODINGS = ("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8", "rgb16", "bgr16", "8UC4")
ENCODINGS += ("yuyv", "yuv422_yuy2", "uyvy", "yuv422")
#: What macOS leaves beside each file that it copies to a foreign disk.
APPLE_DOUBLE = b"\0\5\x16\7\0\2\0\0Mac OS X        " + bytes(100)


def read(path: Path, options: SourceOptions | None = None):
    with open_source(path, options) as source:
        return list(source), source


def copied_by_macos(folder: Path) -> Path:
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(APPLE_DOUBLE)
    return folder


def cloud_folder(folder: Path) -> Path:
    for name in ("9.pcd", "10.PCD"):
        write_pcd(folder / name, back_projected(FRAME), FRAME.color, "binary")
    return folder


def scannet_folder(folder: Path) -> Path:
    for name in ("9", "10"):
        write_image(folder / "color" / f"{name}.png", FRAME.color)
        write_image(folder / "depth" / f"{name}.png", FRAME.depth_mm)
    (folder / "intrinsic").mkdir()
    for word in ("depth", "color"):
        text = "50 0 31.5 0\n0 50 23.5 0\n0 0 1 0\n0 0 0 1\n"
        (folder / "intrinsic" / f"intrinsic_{word}.txt").write_text(text)
    return folder


def split_folder(folder: Path) -> Path:
    for part in (0, 1):
        bag = Bag(folder / f"b_{part}.mcap")
        bag.camera("/c", FRAME, CAMERA, STAMP + part * 33_333_333)
        bag.close()
    return folder


@pytest.mark.parametrize("make", [cloud_folder, scannet_folder, split_folder])
def test_the_hidden_files_of_macos_are_no_part_of_a_recording(tmp_path: Path, make) -> None:
    frames, source = read(copied_by_macos(make(tmp_path)))
    assert len(frames) == 2 and "damaged" not in source.metadata
    for frame in frames:
        np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    if make is cloud_folder:
        assert [frame.name for frame in frames] == ["9", "10"]


def clouds_in_mm(folder: Path) -> Path:
    points_mm = (back_projected(FRAME) * 1000).reshape(-1, 3)
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 64\nHEIGHT 48\nPOINTS 3072\nDATA binary\n"
    )
    (folder / "a.pcd").write_bytes(head.encode() + points_mm.astype("<f4").tobytes())
    return folder / "a.pcd"


def floats_in_mm(folder: Path) -> Path:
    bag = Bag(folder / "a.mcap")
    bag.info("/c/depth/camera_info", STAMP, "c", CAMERA)
    bag.image("/c/depth/image", STAMP, "c", FRAME.depth_mm.astype(np.float32), "32FC1")
    return bag.close()


@pytest.mark.parametrize("make", [clouds_in_mm, floats_in_mm])
def test_depth_in_millimeters_for_meters_is_said_and_read_by_the_flag(tmp_path: Path, make, caplog) -> None:
    path = make(tmp_path)
    (frame,), _ = read(path)
    assert not frame.depth_mm.any()
    assert "no pixel has depth of up to 65 m; depth is read as 1 per meter" in caplog.text
    caplog.clear()
    (frame,), _ = read(path, SourceOptions(depth_scale=1000))
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    assert "if that is wrong" not in caplog.text


@pytest.mark.parametrize(
    ("none_mm", "part", "is_said"), [(10_000, 10, True), (10_000, 40, False), (1100, 10, False)]
)
def test_one_far_value_of_many_pixels_is_doubted(
    tmp_path: Path, none_mm: int, part: int, is_said: bool, caplog
) -> None:
    depth_mm = np.tile(np.arange(1000, 1064, dtype=np.uint16), (48, 1))
    depth_mm.flat[::part] = none_mm
    write_image(tmp_path / "a_color.png", FRAME.color)
    write_image(tmp_path / "a_depth.png", depth_mm)
    read(tmp_path, GIVEN)
    assert ("of the depth is exactly" in caplog.text) is is_said
    assert ("10% of the depth is exactly 10000 mm, as for none (--range-max" in caplog.text) is is_said


@pytest.mark.parametrize("given", [None, 2000.0])
def test_depth_in_pgm_with_the_low_byte_first_is_recognized(tmp_path: Path, given: float | None) -> None:
    # Nearer than 2.048 m, as an 11-bit disparity may be, too.
    depth_mm = np.tile(np.arange(1000, 2024, 16, dtype=np.uint16), (48, 1))
    write_image(tmp_path / "a_color.png", FRAME.color)
    content = b"P5\n64 48\n65535\n" + depth_mm.astype("<u2").tobytes()
    (tmp_path / "a_depth.pgm").write_bytes(content)
    (frame,), source = read(tmp_path, SourceOptions(intrinsics=K, depth_scale=given))
    np.testing.assert_array_equal(frame.depth_mm, depth_mm // (2 if given else 1))
    assert "low byte first" in source.metadata["depth_unit"]
