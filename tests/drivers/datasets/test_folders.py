"""Folders of image pairs: names, calibration, ground truth, and what can be wrong with them."""

import re
from pathlib import Path
from urllib.parse import urlencode

import cv2
import numpy as np
import pytest
from recorded_scene import APART, CAMERA, scene, scenes, write_image, write_pairs

from nurbseg.drivers import (
    FrameFormatError,
    RecordingFormatError,
    SourceOptions,
    open_source,
)
from nurbseg.drivers.datasets.pairs import find_pairs, key_and_role

GIVEN = SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))


@pytest.mark.parametrize(
    ("color", "depth", "name"),
    [
        ("learn0_color.png", "learn0_depth.png", "learn0"),
        ("a_b_color.jpg", "a_b_depth.png", "a_b"),
        ("frame-000001.color.jpg", "frame-000001.depth.png", "frame-000001"),
        ("rgb_0.png", "depth_0.png", "0"),
        ("rgb.png", "depth.png", "rgb"),
        ("x_rgb.tiff", "x_depth.tiff", "x"),
        ("NYU_color.ppm", "NYU_depth.pgm", "NYU"),
        ("A_RGB.PNG", "A_Depth.PNG", "A"),
        ("color/7.png", "depth/7.png", "7"),
        ("rgb/s-1.jpg", "depth/s-1.png", "s-1"),
        ("rgb/rgb_7.png", "depth/depth_7.png", "7"),
    ],
)
def test_pairs_are_found_by_the_names_people_give_them(
    tmp_path: Path, color: str, depth: str, name: str
) -> None:
    frame = scene(0)
    write_image(tmp_path / color, frame.color)
    write_image(tmp_path / depth, frame.depth_mm)
    (tmp_path / "README.md").write_text("of something else")
    with open_source(tmp_path, GIVEN) as source:
        (read,) = list(source)
    np.testing.assert_array_equal(read.depth_mm, frame.depth_mm)
    assert read.name == name
    assert read.labels is None
    if not color.endswith("jpg"):
        np.testing.assert_array_equal(read.color, frame.color)


def test_frames_of_one_camera_share_their_calibration(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(2))
    with open_source(tmp_path, SourceOptions()) as source:
        first, second = source
    assert first.calibration is second.calibration


def patterns(folder: Path, color: str, depth: str) -> str:
    return f"images:?{urlencode({'color': str(folder / color), 'depth': str(folder / depth)})}"


@pytest.mark.parametrize(
    ("colors", "depths", "color", "depth"),
    [
        (["cam/IMG_7.png", "cam/IMG_10.png"], ["z/D-007.png", "z/D-010.png"], "cam/IMG_*.png", "z/D-*.png"),
        (["one/c.png", "two/c.png"], ["one/z.png", "two/z.png"], "*/c.png", "*/z.png"),
        (["a1.png", "a2.png"], ["b1.png", "b2.png"], "a[0-9].png", "b?.png"),
        # Nothing in common, as many of both: in order.
        (["c 1.5.png", "c 2.5.png"], ["z 1.4.png", "z 2.6.png"], "c *.png", "z *.png"),
    ],
)
def test_images_of_any_names_are_paired_by_two_patterns(
    tmp_path: Path, colors: list[str], depths: list[str], color: str, depth: str
) -> None:
    for number, (of_color, of_depth) in enumerate(zip(colors, depths, strict=True)):
        write_image(tmp_path / of_color, scene(number).color)
        write_image(tmp_path / of_depth, scene(number).depth_mm)
    with open_source(patterns(tmp_path, color, depth), GIVEN) as source:
        frames = list(source)
    assert [frame.name for frame in frames] == [Path(color).stem for color in colors]
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, scene(number).color)
        np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)


def test_patterns_that_pair_nothing_are_refused(tmp_path: Path) -> None:
    for name in ("a1.png", "a2.png", "a02.png", "b3.png"):
        write_image(tmp_path / name, scene(0).depth_mm)
    for color, depth, message in (
        ("c*.png", "b*.png", r"c\*\.png: no file matches this pattern"),
        ("a[12].png", "b*.png", r"2 color and 1 depth images, whose names have nothing in common"),
        ("a*.png", "b*.png", r"a2\.png: matches the wildcards with the same text as .*a02\.png"),
    ):
        with pytest.raises(RecordingFormatError, match=message):
            open_source(patterns(tmp_path, color, depth), GIVEN)
    with pytest.raises(RecordingFormatError, match="expected images:"):
        open_source("images:?color=a", GIVEN)


def test_images_without_a_partner_among_the_patterns_are_counted(tmp_path: Path) -> None:
    for number in range(3):
        write_image(tmp_path / f"c{number}.jpg", scene(0).color)
        write_image(tmp_path / f"z{number + 1}.png", scene(0).depth_mm)
    (tmp_path / "camera.toml").write_text("registered = true\n[color]\nfx = 52\nfy = 52\ncx = 31\ncy = 23\n")
    with open_source(patterns(tmp_path, "c*.jpg", "z*.png"), SourceOptions()) as source:
        assert source.metadata["dropped"] == "2"
        assert source.calibration.depth.fx == 52
        assert [frame.name for frame in source] == ["c1", "c2"]


def test_the_error_for_a_folder_of_other_names_gives_names_and_patterns(tmp_path: Path) -> None:
    write_image(tmp_path / "left.png", scene(0).color)
    with pytest.raises(RecordingFormatError, match=r"NAME_color\.png.*--color 'GLOB' --depth 'GLOB'"):
        open_source(tmp_path, GIVEN)


@pytest.mark.parametrize("stem", ["colorful", "depths", "my-deep", "label7x", "camera", "coloring_1", ""])
def test_names_that_only_resemble_are_left_alone(stem: str) -> None:
    assert key_and_role(stem) is None


def test_frames_are_in_natural_order_and_a_thirtieth_of_a_second_apart(tmp_path: Path) -> None:
    for number in (10, 9, 100, 1):
        write_image(tmp_path / f"shot{number}_color.png", scene(0).color)
        write_image(tmp_path / f"shot{number}_depth.png", scene(0).depth_mm)
    with open_source(tmp_path, GIVEN) as source:
        frames = list(source)
    assert [frame.name for frame in frames] == ["shot1", "shot9", "shot10", "shot100"]
    assert [frame.timestamp_ns for frame in frames] == [0, 33_333_333, 66_666_666, 99_999_999]


def test_ground_truth_is_read_where_there_is_one(tmp_path: Path) -> None:
    frames = [scene(0), scene(1, labels=False), scene(2)]
    with open_source(write_pairs(tmp_path, frames)) as source:
        again = list(source)
    assert [frame.labels is None for frame in again] == [False, True, False]
    np.testing.assert_array_equal(again[2].labels, frames[2].labels)


def test_images_without_a_partner_are_dropped_counted_and_named(tmp_path: Path, caplog) -> None:
    write_pairs(tmp_path, scenes(4))
    (tmp_path / "shot1_color.png").unlink()
    (tmp_path / "shot3_depth.png").unlink()
    with open_source(tmp_path) as source:
        assert source.metadata["dropped"] == "2"
        assert [frame.name for frame in source] == ["shot0", "shot2"]
    assert (
        "2 images are left out, since they lack their partner: shot1_depth.png, shot3_color.png"
        in caplog.text
    )


def test_two_files_for_one_place_are_refused(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(1))
    write_image(tmp_path / "shot0_color.jpg", scene(0).color)
    with pytest.raises(RecordingFormatError, match=r"shot0_color.*is already the color image of 'shot0'"):
        find_pairs(tmp_path)


def test_color_of_another_size_and_the_same_shape_has_its_intrinsics_scaled(tmp_path: Path) -> None:
    frame = scene(0)
    write_image(tmp_path / "a_color.png", cv2.resize(frame.color, (128, 96)))
    write_image(tmp_path / "a_depth.png", frame.depth_mm)
    (tmp_path / "intrinsics.txt").write_text("52.5 0 31.5\n0 52.5 23.5\n0 0 1\n")
    with open_source(tmp_path) as source:
        assert source.calibration.color.fx == 105.0
        assert source.calibration.color.cx == 63.5
        assert source.calibration.depth.fx == 52.5
        assert not source.calibration.is_registered
        assert source.read().color.shape == (96, 128, 3)


def test_color_of_another_shape_is_refused_and_says_what_would_help(tmp_path: Path) -> None:
    frame = scene(0)
    write_image(tmp_path / "a_color.png", frame.color[:40])
    write_image(tmp_path / "a_depth.png", frame.depth_mm)
    with pytest.raises(
        RecordingFormatError, match=r"a_color\.png \(64x40\) and a_depth\.png \(64x48\).*another aspect ratio"
    ):
        open_source(tmp_path, GIVEN)


def test_two_cameras_with_sizes_of_their_own_are_right(tmp_path: Path) -> None:
    with open_source(write_pairs(tmp_path, scenes(2, APART))) as source:
        assert source.calibration.color.width == 80
        np.testing.assert_array_equal(source.calibration.color_from_depth, APART.color_from_depth)


def test_intrinsics_that_are_none_are_named_after_the_flag(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(1), calibration=False)
    for wrong in ((float("nan"), 1.0, 1.0, 1.0), (0.0, 1.0, 1.0, 1.0)):
        with pytest.raises(RecordingFormatError, match=r"--intrinsics.*fx"):
            open_source(tmp_path, SourceOptions(intrinsics=wrong))


def spoil(folder: Path, kind: str) -> None:
    """Make the second of three frames unusable."""
    color, depth = (folder / f"shot1_{role}.png" for role in ("color", "depth"))
    if kind == "cut color":
        color.write_bytes(color.read_bytes()[:-300])
    elif kind == "cut depth":
        depth.write_bytes(depth.read_bytes()[:-5])
    elif kind == "damaged depth":
        content = bytearray(depth.read_bytes())
        content[len(content) // 2] ^= 1
        depth.write_bytes(content)
    elif kind == "empty depth":
        depth.write_bytes(b"")
    elif kind == "text":
        color.write_text("not an image")
    elif kind == "8-bit depth":
        write_image(depth, (scene(1).depth_mm >> 8).astype(np.uint8))
    elif kind == "color depth":
        write_image(depth, scene(1).color)
    elif kind == "other size":
        write_image(depth, scene(1).depth_mm[:24])
    elif kind == "directory":
        depth.unlink()
        depth.symlink_to(folder / "nowhere.png")


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("cut color", r"shot1_color\.png: the image is cut off"),
        ("cut depth", r"shot1_depth\.png: the image is cut off"),
        ("damaged depth", r"shot1_depth\.png: the image is cut off or damaged"),
        ("empty depth", r"shot1_depth\.png: the image is empty"),
        ("text", r"shot1_color\.png: not an image"),
        ("8-bit depth", r"shot1_depth\.png: expected a depth image of 1 channel of 16 bits, got 1 of 8"),
        ("color depth", r"shot1_depth\.png: expected a depth image of 1 channel of 16 bits, got 3 of 8"),
        ("other size", r"shot1_color\.png \(64x48\) and shot1_depth\.png \(64x24\)"),
        ("directory", r"shot1_depth\.png: the image cannot be read"),
    ],
)
def test_one_bad_frame_is_named_and_the_run_continues(tmp_path: Path, kind: str, text: str) -> None:
    write_pairs(tmp_path, scenes(3))
    spoil(tmp_path, kind)
    with open_source(tmp_path) as source:
        assert source.read().index == 0
        with pytest.raises(FrameFormatError, match=text):
            source.read()
        assert source.read().index == 2


@pytest.mark.parametrize(
    ("image", "text"),
    [
        (scene(1).depth_mm[:24], r"expected the depth image's size 64x48, got 64x24"),
        (np.ones((60, 64), np.uint16), r"expected the depth image's size 64x48, got 64x60"),
        (scene(1).color, "expected labels of 1 channel"),
        (None, "the image is empty"),
    ],
)
def test_an_unusable_label_image_costs_the_labels_of_its_frame_only(
    tmp_path: Path, image: np.ndarray | None, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    write_pairs(tmp_path, scenes(4))
    for number in (1, 2):
        path = tmp_path / f"shot{number}_label.png"
        if image is None:
            path.write_bytes(b"")
        else:
            write_image(path, image)
    with open_source(tmp_path) as source:
        frames, faults = [], []
        for _ in range(4):
            frames.append(source.read())
            faults.append(source.labels_fault)
        assert source.metadata["unusable_labels"] == "2"
    assert (faults[0], faults[3]) == ("", "")
    for number in (1, 2):
        assert re.search(f"shot{number}_label.png: {text}", faults[number])
    assert [frame.labels is None for frame in frames] == [False, True, True, False]
    (message,) = caplog.messages
    assert re.search(f"shot1_label.png: {text}", message)


@pytest.mark.parametrize("form", ["png", "tiff", "npy", "pgm"])
@pytest.mark.parametrize("place", ["depth/{}.{}", "{}_depth.{}"])
def test_depth_without_color_is_gray(
    tmp_path: Path, form: str, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(2):
        path = tmp_path / place.format(number, form)
        path.parent.mkdir(exist_ok=True)
        depth = scene(number).depth_mm
        if form == "npy":
            np.save(path, depth)
        else:
            write_image(path, (depth / 1000).astype(np.float32) if form == "tiff" else depth)
    with open_source(tmp_path, SourceOptions(calibration=APART)) as source:
        frames = [source.read(), source.read()]
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)
        assert (frame.color == 128).all()
        assert frame.calibration.is_registered
        assert frame.calibration.depth.fx == APART.depth.fx
    assert "has no color images that can be read; the color is gray" in caplog.text


def test_where_some_have_color_depth_alone_is_dropped(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(3))
    (tmp_path / "shot1_color.png").unlink()
    with open_source(tmp_path) as source:
        assert (len(source), source.metadata["dropped"]) == (2, "1")


def test_images_of_another_size_are_read_with_a_scaled_calibration(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number, size in enumerate([(64, 48), (128, 96), (64, 48), (64, 40), (128, 96)]):
        write_image(tmp_path / f"{number}_color.png", cv2.resize(scene(0).color, size))
        nearest = cv2.resize(scene(0).depth_mm, size, interpolation=cv2.INTER_NEAREST)
        write_image(tmp_path / f"{number}_depth.png", nearest)
    with open_source(tmp_path, GIVEN) as source:
        first, second = source.read(), source.read()
        assert source.read().calibration is first.calibration
        with pytest.raises(FrameFormatError, match=r"3_depth\.png \(64x40\).*another aspect ratio"):
            source.read()
        last = source.read()
    assert (first.calibration.depth.fx, first.calibration.depth.cx) == (52.5, 31.5)
    # Pixel centers are at whole numbers.
    for frame in (second, last):
        assert (frame.calibration.depth.fx, frame.calibration.depth.cx) == (105.0, 63.5)
    (message,) = caplog.messages
    assert "frame 1 has images of another size" in message


def test_a_bad_first_frame_does_not_keep_the_rest_from_being_replayed(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(3))
    (tmp_path / "shot0_color.png").write_bytes(b"")
    with open_source(tmp_path) as source:
        with pytest.raises(FrameFormatError, match="shot0"):
            source.read()
        assert source.read().index == 1


def test_a_folder_of_nothing_but_bad_frames_is_refused_with_the_first_reason(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(2))
    for path in tmp_path.glob("*_depth.png"):
        path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(RecordingFormatError, match=r"none of the 2 frames.*shot0_depth\.png: .*cut off"):
        open_source(tmp_path)


@pytest.mark.parametrize("name", ["a_color.png", "a_color.jpg"])
def test_a_folder_of_color_images_only_says_which_names_are_expected(tmp_path: Path, name: str) -> None:
    write_image(tmp_path / name, scene(0).color)
    with pytest.raises(RecordingFormatError, match=r"no image pairs \(1 images lack.*NAME_color\.png"):
        open_source(tmp_path, GIVEN)


def test_the_users_calibration_counts_before_the_folders(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(1))
    with open_source(tmp_path, SourceOptions(intrinsics=(60.0, 61.0, 30.0, 20.0))) as source:
        assert source.metadata["calibration"] == "--intrinsics"
        assert source.calibration.depth.fx == 60.0
    with open_source(tmp_path, SourceOptions(calibration=APART)) as source:
        assert source.calibration.color_from_depth[0, 3] == -0.025
        assert source.calibration.color.width == 64
    assert CAMERA.fx == 52.5
