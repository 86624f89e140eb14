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
