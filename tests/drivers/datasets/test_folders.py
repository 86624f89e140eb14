"""Folders of image pairs: names, calibration, ground truth, and what can be wrong with them."""

import re
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlencode

import cv2
import numpy as np
import pytest
import tifffile
from recorded_scene import APART, INTERVAL_NS, scene, scenes, write_image, write_pairs

from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers import FrameFormatError, RecordingFormatError, RGBDFrame, SourceOptions, open_source

GIVEN = SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))
FRAME = scene(0)
#: What macOS leaves beside each file that it copies to a foreign disk.
APPLE_DOUBLE = b"\0\5\x16\7\0\2\0\0Mac OS X        " + bytes(100)


def read(path: Path | str, options: SourceOptions | None = GIVEN) -> list[RGBDFrame]:
    with open_source(path, options) as source:
        return list(source)


def patterns(folder: Path, color: str, depth: str) -> str:
    return f"images:?{urlencode({'color': str(folder / color), 'depth': str(folder / depth)})}"


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
def test_pairs_are_found_by_the_names_people_give_them(tmp_path, color, depth, name):
    for path, image in ((color, FRAME.color), (depth, FRAME.depth_mm)):
        write_image(tmp_path / path, image)
        (tmp_path / path).with_name(f"._{Path(path).name}").write_bytes(APPLE_DOUBLE)
    # Names that only resemble.
    for stem in ("colorful", "depths", "my-deep", "label7x", "camera", "coloring_1"):
        write_image(tmp_path / f"{stem}.png", FRAME.color)
    (tmp_path / "README.md").write_text("of something else")
    (frame,) = read(tmp_path)
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    assert (frame.name, frame.labels) == (name, None)
    if not color.endswith("jpg"):
        np.testing.assert_array_equal(frame.color, FRAME.color)


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
def test_images_of_any_names_are_paired_by_two_patterns(tmp_path, colors, depths, color, depth):
    for number, (of_color, of_depth) in enumerate(zip(colors, depths, strict=True)):
        write_image(tmp_path / of_color, scene(number).color)
        write_image(tmp_path / of_depth, scene(number).depth_mm)
    frames = read(patterns(tmp_path, color, depth))
    assert [frame.name for frame in frames] == [Path(color).stem for color in colors]
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, scene(number).color)
        np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)


@pytest.mark.parametrize(
    ("color", "depth", "said"),
    [
        ("c*.png", "b*.png", r"c\*\.png: no file matches this pattern"),
        ("a[12].png", "b*.png", r"2 color and 1 depth images, whose names have nothing in common"),
        ("a*.png", "b*.png", r"a2\.png: matches the wildcards with the same text as .*a02\.png"),
    ],
)
def test_patterns_that_pair_nothing_are_refused(tmp_path: Path, color: str, depth: str, said: str) -> None:
    for name in ("a1.png", "a2.png", "a02.png", "b3.png"):
        write_image(tmp_path / name, FRAME.depth_mm)
    with pytest.raises(RecordingFormatError, match=said):
        open_source(patterns(tmp_path, color, depth), GIVEN)
    with pytest.raises(RecordingFormatError, match="expected images:"):
        open_source(f"images:?color={color}", GIVEN)


def test_images_without_a_partner_among_the_patterns_are_counted(tmp_path: Path) -> None:
    for number in range(3):
        write_image(tmp_path / f"c{number}.jpg", FRAME.color)
        write_image(tmp_path / f"z{number + 1}.png", FRAME.depth_mm)
    (tmp_path / "camera.toml").write_text("registered = true\n[color]\nfx = 52\nfy = 52\ncx = 31\ncy = 23\n")
    with open_source(patterns(tmp_path, "c*.jpg", "z*.png"), SourceOptions()) as source:
        assert (source.metadata["dropped"], source.calibration.depth.fx) == ("2", 52)
        assert [frame.name for frame in source] == ["c1", "c2"]


@pytest.mark.parametrize(
    "names",
    [
        ["shot1", "shot9", "shot10", "shot100"],
        # As str(time.time()) makes them: without zeros at the end.
        ["1700000000.25", "1700000000.3", "1700000000.333333", "1700000000.9", "1700000001.05"],
    ],
)
def test_frames_are_in_natural_order_and_a_thirtieth_of_a_second_apart(tmp_path, names):
    for name in names[::-1]:
        write_image(tmp_path / "rgb" / f"{name}.png", FRAME.color)
        write_image(tmp_path / "depth" / f"{name}.png", FRAME.depth_mm)
    frames = read(tmp_path)
    assert [frame.name for frame in frames] == names
    assert [frame.timestamp_ns for frame in frames] == [number * INTERVAL_NS for number in range(len(names))]


def test_images_without_a_partner_are_dropped_counted_and_named(tmp_path: Path, caplog) -> None:
    write_pairs(tmp_path, scenes(4))
    for name in ("shot1_color.png", "shot2_label.png", "shot3_depth.png"):
        (tmp_path / name).unlink()
    with open_source(tmp_path) as source:
        assert (len(source), source.metadata["dropped"]) == (2, "2")
        frames = list(source)
    assert [(frame.name, frame.labels is None) for frame in frames] == [("shot0", False), ("shot2", True)]
    said = "2 images are left out, since they lack their partner: shot1_depth.png, shot3_color.png"
    assert said in caplog.text


def images(**given: np.ndarray) -> Callable[[Path], None]:
    """Return what writes images of these names; `__` stands for the last dot."""

    def write(folder: Path) -> None:
        for name, image in given.items():
            path = folder / name.replace("__", ".")
            np.save(path, image) if path.suffix == ".npy" else write_image(path, image)

    return write


def with_tiff(name: str, image: np.ndarray, **how: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        images(a_color__png=FRAME.color, a_depth__png=FRAME.depth_mm)(folder)
        (folder / name).with_suffix(".png").unlink()
        tifffile.imwrite(folder / name, image, **how)  # type: ignore[arg-type]

    return write


def two_of_one(folder: Path) -> None:
    images(a_color__png=FRAME.color, a_color__jpg=FRAME.color, a_depth__png=FRAME.depth_mm)(folder)


def cut_depth(folder: Path) -> None:
    for path in write_pairs(folder, scenes(2)).glob("*_depth.png"):
        path.write_bytes(path.read_bytes()[:40])


RGB, DEPTH = FRAME.color, FRAME.depth_mm
#: What is in a folder, and what is said of it.
REFUSED: list[tuple[Callable[[Path], None], str]] = [
    (images(left__png=RGB), r"NAME_color\.png.*--color 'GLOB' --depth 'GLOB'"),
    (images(a_color__png=RGB), r"no image pairs \(1 images lack.*NAME_color\.png"),
    (two_of_one, r"a_color.*is already the color image of 'a'"),
    (
        images(a_color__png=RGB[:40], a_depth__png=DEPTH),
        r"a_color\.png \(64x40\) and a_depth\.png \(64x48\).*another aspect ratio",
    ),
    (cut_depth, r"none of the 2 frames.*shot0_depth\.png: .*cut off"),
    (
        images(a_color__png=RGB, a_depth__png=(DEPTH >> 4).astype(np.uint8)),
        "got 1 of 8 bits; 8 bits are depth as it is shown",
    ),
    (images(a_color__png=RGB, a_depth__png=np.dstack([RGB, RGB[..., 0]])), "got 4 of 8 bits; colors"),
    (images(a_color__npy=RGB / 255, a_depth__png=DEPTH), r"a_color\.npy: .* got an array of float64"),
    (
        images(a_color__npy=RGB.transpose(2, 0, 1), a_depth__png=DEPTH),
        r"a_color\.npy: expected one image .*\(H, W, 3\), got an array of '?\(3, 48, 64\)",
    ),
    (with_tiff("a_depth.tiff", np.stack([DEPTH, DEPTH])), r"a_depth\.tiff: the TIFF has several images"),
    (with_tiff("a_depth.tiff", (DEPTH / 1000).astype(np.float16)), "of a kind that is not read; save"),
    (with_tiff("a_color.tiff", RGB.astype(np.float32), photometric="rgb"), "not read; save color as 8 bits"),
]


@pytest.mark.parametrize("place", range(len(REFUSED)))
def test_a_folder_that_cannot_be_read_says_why(tmp_path: Path, place: int, capfd) -> None:
    write, said = REFUSED[place]
    write(tmp_path)
    with pytest.raises(RecordingFormatError, match=said):
        open_source(tmp_path, GIVEN)
    # Decoders would write reports of their own.
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("wrong", [(float("nan"), 1.0, 1.0, 1.0), (0.0, 1.0, 1.0, 1.0)])
def test_intrinsics_that_are_none_are_named_after_the_flag(tmp_path: Path, wrong) -> None:
    write_pairs(tmp_path, scenes(1), calibration=False)
    with pytest.raises(RecordingFormatError, match=r"--intrinsics.*fx"):
        open_source(tmp_path, SourceOptions(intrinsics=wrong))


def test_the_users_calibration_counts_before_the_folders(tmp_path: Path) -> None:
    write_pairs(tmp_path, scenes(1))
    with open_source(tmp_path, SourceOptions(intrinsics=(60.0, 61.0, 30.0, 20.0))) as source:
        assert source.metadata["calibration"] == "--intrinsics"
        assert source.calibration.depth.fx == 60.0
    with open_source(tmp_path, SourceOptions(calibration=APART)) as source:
        assert source.calibration.color_from_depth[0, 3] == -0.025
        assert source.calibration.color.width == 64


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"
SMALL = scene(1).depth_mm[:24]
#: The second of three frames: the image that is spoiled, what becomes of its bytes, and what is said.
SPOILED: list[tuple[str, Callable[[bytes], bytes | np.ndarray], str]] = [
    ("color", lambda content: content[:-300], r"shot1_color\.png: the image is cut off"),
    ("depth", lambda content: content[:-5], r"shot1_depth\.png: the image is cut off"),
    (
        "depth",
        lambda content: content[:200] + bytes([content[200] ^ 1]) + content[201:],
        r"shot1_depth\.png: the image is cut off or damaged",
    ),
    ("depth", lambda content: b"", r"shot1_depth\.png: the image is empty"),
    ("color", lambda content: b"not an image", r"shot1_color\.png: not an image"),
    ("depth", lambda content: RGB, "expected a depth image of 1 channel of 16 bits, got 3 of 8"),
    ("depth", lambda content: SMALL, r"shot1_color\.png \(64x48\) and shot1_depth\.png \(64x24\)"),
    ("depth", lambda content: LFS, r"shot1_depth\.png: not an image.*git lfs pull"),
    ("depth", lambda content: b"<html><body>404</body></html>", "not an image.*an HTML page"),
]  # fmt: skip


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("place", range(len(SPOILED)))
def test_one_bad_frame_is_named_and_the_run_continues(tmp_path: Path, place: int, first: bool) -> None:
    kind, spoil, said = SPOILED[place]
    number = 0 if first else 1
    path = write_pairs(tmp_path, scenes(3)) / f"shot{number}_{kind}.png"
    spoiled = spoil(path.read_bytes())
    path.write_bytes(spoiled) if isinstance(spoiled, bytes) else write_image(path, spoiled)
    with open_source(tmp_path) as source:
        for index in range(3):
            if index == number:
                with pytest.raises(FrameFormatError, match=said.replace("shot1", f"shot{number}")):
                    source.read()
            else:
                assert source.read().index == index


@pytest.mark.parametrize(
    ("image", "text"),
    [
        (scene(1).depth_mm[:24], r"expected the depth image's size 64x48, got 64x24"),
        (np.ones((60, 64), np.uint16), r"expected the depth image's size 64x48, got 64x60"),
        (scene(1).color, "expected labels of 1 channel"),
        (None, "the image is empty"),
    ],
)
def test_an_unusable_label_image_costs_the_labels_of_its_frame_only(tmp_path, image, text, caplog):
    write_pairs(tmp_path, scenes(4))
    for number in (1, 2):
        path = tmp_path / f"shot{number}_label.png"
        path.write_bytes(b"") if image is None else write_image(path, image)
    with open_source(tmp_path) as source:
        found = [(source.read().labels is None, source.labels_fault) for _ in range(4)]
        assert source.metadata["unusable_labels"] == "2"
    assert found[0] == found[3] == (False, "")
    for number in (1, 2):
        assert found[number][0] and re.search(f"shot{number}_label.png: {text}", found[number][1])
    (message,) = caplog.messages
    assert re.search(f"shot1_label.png: {text}", message)


@pytest.mark.parametrize(("name", "found"), [("{}_label", True), ("{:06d}", False), ("{}", True)])
def test_labels_whose_names_fit_no_frame_are_said(tmp_path: Path, name: str, found: bool, caplog) -> None:
    for number in range(2):
        write_image(tmp_path / "color" / f"{number}.png", FRAME.color)
        write_image(tmp_path / "depth" / f"{number}.png", FRAME.depth_mm)
        write_image(tmp_path / "label" / f"{name.format(number)}.png", FRAME.labels)
    assert [frame.labels is not None for frame in read(tmp_path)] == [found, found]
    said = "2 images are left out, since they lack their partner: 000000.png, 000001.png"
    assert (said in caplog.text) is not found


@pytest.mark.parametrize("shift_m", [0.0, 0.06])
def test_labels_of_color_are_those_of_the_depth_pixels_that_show_the_same(tmp_path, shift_m):
    depth = Intrinsics(64, 48, 57.6, 57.6, 31.5, 23.1)
    color = Intrinsics(130, 97, 116.0, 116.2, 64.0, 48.0)
    step = np.eye(4)
    step[0, 3] = shift_m
    labels = np.full((97, 130), 3, np.uint16)
    labels[20:60, 40:90] = 5001
    frame = scene(0, Calibration(depth, color, step))
    for kind, image in (("color", frame.color), ("depth", frame.depth_mm), ("label", labels)):
        write_image(tmp_path / kind / "0.png", image)
    (found,) = read(tmp_path, SourceOptions(calibration=frame.calibration))
    expected = np.zeros((48, 64), np.uint16)
    for v, u in np.argwhere(frame.depth_mm > 0):
        z = frame.depth_mm[v, u] / 1000
        x, y = (u - depth.cx) / depth.fx * z + shift_m, (v - depth.cy) / depth.fy * z
        column, row = round(x / z * color.fx + color.cx), round(y / z * color.fy + color.cy)
        if 0 <= column < 130 and 0 <= row < 97:
            expected[v, u] = labels[row, column]
    np.testing.assert_array_equal(found.labels, expected)
    assert set(np.unique(expected)) == {0, 3, 5001}


@pytest.mark.parametrize("form", ["png", "tiff", "npy", "pgm"])
@pytest.mark.parametrize("place", ["depth/{}.{}", "{}_depth.{}"])
def test_depth_without_color_is_gray(tmp_path, form, place, caplog):
    for number in range(2):
        path = tmp_path / place.format(number, form)
        path.parent.mkdir(exist_ok=True)
        depth = scene(number).depth_mm
        if form == "npy":
            np.save(path, depth)
        else:
            write_image(path, (depth / 1000).astype(np.float32) if form == "tiff" else depth)
    for number, frame in enumerate(read(tmp_path, SourceOptions(calibration=APART))):
        np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)
        assert (frame.color == 128).all()
        assert frame.calibration.is_registered
        assert frame.calibration.depth.fx == APART.depth.fx
    assert "has no color images that can be read; the color is gray" in caplog.text


def test_images_of_another_size_are_read_with_a_scaled_calibration(tmp_path, caplog):
    for number, size in enumerate([(64, 48), (128, 96), (64, 48), (64, 40), (128, 96)]):
        write_image(tmp_path / f"{number}_color.png", cv2.resize(FRAME.color, size))
        nearest = cv2.resize(FRAME.depth_mm, size, interpolation=cv2.INTER_NEAREST)
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


def test_color_of_another_size_and_the_same_shape_has_its_intrinsics_scaled(tmp_path: Path) -> None:
    images(a_color__png=cv2.resize(RGB, (128, 96)), a_depth__png=DEPTH)(tmp_path)
    (frame,) = read(tmp_path)
    cameras = frame.calibration
    assert (cameras.color.fx, cameras.color.cx, cameras.depth.fx) == (105.0, 63.5, 52.5)
    assert not cameras.is_registered and frame.color.shape == (96, 128, 3)


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("gone", ["calibration.xml", "*.png"])
def test_a_scene_without_calibration_or_images_is_named(tmp_path: Path, number: int, gone: str) -> None:
    from recorded_forms import numbered_scenes

    numbered_scenes(tmp_path, scenes(2, APART))
    for path in (tmp_path / f"scene{number}").glob(gone):
        path.unlink()
    with pytest.raises(RecordingFormatError, match=f"scene{number}"):
        open_source(tmp_path)
    if gone == "calibration.xml":
        with open_source(tmp_path, GIVEN) as source:
            assert [frame.calibration.color.fx for frame in source] == [65.625, 65.625]
