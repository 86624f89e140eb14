"""Files as other programs and systems leave them: stray files, other units, layouts and encodings."""

import json
from pathlib import Path

import numpy as np
import pytest
from recorded_scene import CAMERA, back_projected, scene, write_image, write_pcd
from robot_bag import Bag, encoded

from nurbseg.common.frame import Intrinsics
from nurbseg.drivers import CalibrationError, RecordingFormatError, SourceOptions, open_source
from nurbseg.drivers.mcap import ros_messages as ros

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


def of_yuv(rgb: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return Y, U and V of ITU-R BT.601 with limited range."""
    r, g, b = np.moveaxis(rgb.astype(float), -1, 0)
    y = 16 + (65.481 * r + 128.553 * g + 24.966 * b) / 255
    u = 128 + (-37.797 * r - 74.203 * g + 112.0 * b) / 255
    v = 128 + (112.0 * r - 93.786 * g - 18.214 * b) / 255
    return tuple(np.rint(each).astype(np.uint8) for each in (y, u, v))


def camera_image(rgb: np.ndarray, encoding: str) -> np.ndarray:
    """Return the pixels of an image of one color in an encoding of ROS."""
    if encoding.startswith("bayer"):
        mosaic = np.zeros(rgb.shape[:2], np.uint8)
        for place, letter in enumerate(encoding[6:10]):
            mosaic[place // 2 :: 2, place % 2 :: 2] = rgb[0, 0, "rgb".index(letter)]
        return mosaic
    if encoding.endswith("16"):
        return (rgb if encoding == "rgb16" else rgb[..., ::-1]).astype(np.uint16) * 257
    if encoding == "8UC4":
        return np.dstack([rgb[..., ::-1], np.zeros(rgb.shape[:2], np.uint8)])
    y, u, v = of_yuv(rgb)
    chroma = np.where(np.arange(rgb.shape[1]) % 2 == 0, u, v)
    is_y_first = encoding in ("yuyv", "yuv422_yuy2")
    return np.dstack([y, chroma] if is_y_first else [chroma, y])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_encodings_of_cameras_are_color(tmp_path: Path, encoding: str) -> None:
    rgb = np.full((48, 64, 3), (200, 60, 120), np.uint8)
    bag = Bag(tmp_path / "a.mcap")
    bag.info("/c/camera_info", STAMP, "c", CAMERA)
    bag.image("/c/depth/image", STAMP, "c", FRAME.depth_mm, "16UC1")
    bag.image("/c/rgb/image_raw", STAMP, "c", camera_image(rgb, encoding), encoding)
    (frame,), _ = read(bag.close())
    assert np.abs(frame.color.astype(int) - rgb).max() <= (2 if "y" in encoding[:3] else 0)


def test_16_bit_png_is_depth_though_its_format_says_png_alone(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "a.mcap")
    bag.info("/c/camera_info", STAMP, "c", CAMERA)
    bag.compressed("/c/depth/compressed", STAMP, "c", encoded(".png", FRAME.depth_mm), "png")
    bag.compressed("/c/depth/a/compressed", STAMP, "c", encoded(".png", FRAME.color), "png")
    (frame,), _ = read(bag.close())
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)


@pytest.mark.parametrize(
    ("topic", "encoding"),
    [("/c/ir/image", "16UC1"), ("/c/confidence/map", "32FC1"), ("/c/disparity/image", "32FC1")],
)
def test_images_of_depths_encoding_but_another_name_are_read_on_request_only(
    tmp_path: Path, topic: str, encoding: str
) -> None:
    bag = Bag(tmp_path / "a.mcap")
    bag.info("/c/camera_info", STAMP, "c", CAMERA)
    image = FRAME.depth_mm if encoding == "16UC1" else FRAME.depth_mm.astype(np.float32) / 1000
    bag.image(topic, STAMP, "c", image, encoding)
    bag.image("/c/rgb/image_raw", STAMP, "c", FRAME.color, "rgb8")
    path = bag.close()
    with pytest.raises(RecordingFormatError, match=rf"{topic}: not depth by the name, but --depth-topic"):
        open_source(path)
    (frame,), _ = read(path, SourceOptions(depth_topic=topic))
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)


def test_a_camera_in_parts_of_the_image_is_refused(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "a.mcap")
    bag.info("/c/camera_info", STAMP, "c", CAMERA, k=[0.82, 0, 0.5, 0, 1.09, 0.5, 0, 0, 1])
    bag.image("/c/depth/image", STAMP, "c", FRAME.depth_mm, "16UC1")
    path = bag.close()
    with pytest.raises(CalibrationError, match=r"fx, fy: expected focal lengths in pixels of 64x48"):
        open_source(path)


def two_cameras(folder: Path, x: float, form: str) -> Path:
    camera = {"width": 64, "height": 48, "fx": 52.5, "fy": 52.5, "cx": 31.5, "cy": 23.5}
    if form == "json":
        step = {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [x, 0, 0]}
        (folder / "calib.json").write_text(
            json.dumps({"depth": camera, "color": camera, "depth_to_color": step})
        )
    elif form == "texts":
        scannet_folder(folder)
        for name, place in (("depth", x), ("color", 0)):
            text = f"1 0 0 {place}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
            (folder / "intrinsic" / f"extrinsic_{name}.txt").write_text(text)
    else:
        lines = [f"{key} = {value}" for key, value in camera.items()]
        step = f"color_from_depth = [[1, 0, 0, {x}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
        (folder / "camera.toml").write_text("\n".join([step, "[depth]", *lines, "[color]", *lines]))
    write_image(folder / "a_color.png", FRAME.color)
    write_image(folder / "a_depth.png", FRAME.depth_mm)
    return folder


@pytest.mark.parametrize(
    ("form", "x", "expected_m", "text"),
    [
        ("json", -32.0, -0.032, "taken to be 32 mm apart: too far for meters"),
        ("json", -0.5, -0.5, ""),
        ("texts", -32.0, -0.032, "taken to be 32 mm apart: too far for meters"),
        ("toml", -32.0, -32.0, "taken to be 32 m apart: if these are millimeters, state meters"),
    ],
)
def test_cameras_that_are_too_far_apart_for_one_sensor_are_said(
    tmp_path: Path, form: str, x: float, expected_m: float, text: str, caplog
) -> None:
    frames, _ = read(two_cameras(tmp_path, x, form))
    assert frames[0].calibration.color_from_depth[0, 3] == pytest.approx(expected_m)
    assert text in caplog.text and (text != "" or "apart" not in caplog.text)


def test_a_matrix_of_images_that_were_turned_is_said(tmp_path: Path, caplog) -> None:
    write_image(tmp_path / "a_color.png", np.ascontiguousarray(FRAME.color.transpose(1, 0, 2)))
    write_image(tmp_path / "a_depth.png", np.ascontiguousarray(FRAME.depth_mm.T))
    read(tmp_path, GIVEN)
    assert "the principal point (31.5, 23.5) is far from the middle of the images of 48x64" in caplog.text


@pytest.mark.parametrize(("far_m", "is_said"), [(1.0, True), (1.5, False)])
def test_depth_as_a_part_of_the_farthest_is_doubted(
    tmp_path: Path, far_m: float, is_said: bool, caplog
) -> None:
    write_image(tmp_path / "a_color.png", FRAME.color)
    np.save(tmp_path / "a_depth.npy", FRAME.depth_mm * (far_m / FRAME.depth_mm.max()))
    read(tmp_path, GIVEN)
    assert ("the farthest depth is exactly 1 m, as where it is scaled" in caplog.text) is is_said


def test_names_with_a_time_of_their_own_are_paired_though_the_first_is_the_same(tmp_path: Path) -> None:
    for number in range(3):
        write_image(tmp_path / "rgb" / f"{number + 1:07d}-{33_369 * number:012d}.jpg", FRAME.color)
        write_image(tmp_path / "depth" / f"{number + 1:07d}-{33_000 * number:012d}.png", FRAME.depth_mm)
    frames, source = read(tmp_path, GIVEN)
    assert len(frames) == 3 and source.metadata["dropped"] == "0"


@pytest.mark.parametrize("index", ["[1, 2]", '"x"', "3"])
def test_an_index_of_another_shape_is_named(tmp_path: Path, index: str) -> None:
    write_image(tmp_path / "rgb" / "000000.png", FRAME.color)
    write_image(tmp_path / "depth" / "000000.png", FRAME.depth_mm)
    (tmp_path / "scene_camera.json").write_text(index)
    with pytest.raises(RecordingFormatError, match=r"scene_camera\.json: expected a camera for each image"):
        open_source(tmp_path)
    (tmp_path / "scene_camera.json").unlink()
    frames = [{"file_path": 3, "depth_file_path": None}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(RecordingFormatError, match=r"transforms\.json: frames: expected file_path"):
        open_source(tmp_path)


def tum_folder(folder: Path, stamps: list[str], factor: float = 5.0) -> Path:
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    for number, stamp in enumerate(stamps):
        write_image(folder / "rgb" / f"{number}.png", FRAME.color)
        write_image(folder / "depth" / f"{number}.png", (FRAME.depth_mm * factor).astype(np.uint16))
        for kind, line in lines.items():
            line.append(f"{stamp} {kind}/{number}.png")
    for kind, line in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(line))
    return folder


@pytest.mark.parametrize(
    ("stamps", "expected_ns"),
    [
        (["1700000000100.5", "1700000000133.75"], [STAMP + 100_500_000, STAMP + 133_750_000]),
        (["5000100.5", "5000133.75", "5000167"], [5_000_100_500_000, 5_000_133_750_000, 5_000_167_000_000]),
    ],
)
def test_stamps_of_milliseconds_are_recognized(tmp_path: Path, stamps, expected_ns) -> None:
    frames, _ = read(tum_folder(tmp_path, stamps), GIVEN)
    assert [frame.timestamp_ns for frame in frames] == expected_ns


@pytest.mark.parametrize(("factor", "is_said"), [(5.0, False), (0.9, True)])
def test_millimeters_in_tums_layout_are_doubted(tmp_path: Path, factor: float, is_said: bool, caplog) -> None:
    # Half of the scene is nearer than 1.5 m, and was stored as if it were of millimeters.
    read(tum_folder(tmp_path, ["1.0", "1.1"], factor), GIVEN)
    assert ("m, as millimeters would be; depth is read as 5000 per meter" in caplog.text) is is_said


def test_poses_of_other_times_are_said(tmp_path: Path, caplog) -> None:
    folder = tum_folder(tmp_path, ["1.0", "1.1"])
    (folder / "groundtruth.txt").write_text("1000000000 0 0 0 0 0 0 1\n1100000000 0 0 0 0 0 0 1\n")
    frames, _ = read(folder, GIVEN)
    assert frames[0].world_from_camera is None
    assert "no pose is within 0.02 s of an image: are its times seconds?" in caplog.text


def test_depth_may_come_first_in_a_list_of_pairs_in_folders(tmp_path: Path) -> None:
    write_image(tmp_path / "depth_1" / "rgb" / "0.png", FRAME.color)
    write_image(tmp_path / "depth_1" / "depth" / "0.png", FRAME.depth_mm)
    (tmp_path / "associations.txt").write_text("1.5 depth_1/depth/0.png 1.6 depth_1/rgb/0.png")
    (frame,), _ = read(tmp_path, SourceOptions(intrinsics=K, depth_scale=1000))
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    assert frame.timestamp_ns == 1_500_000_000


def test_commas_and_the_names_of_windows_are_read_in_lists(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path, ["1.0", "1.1"])
    for name in ("rgb.txt", "depth.txt"):
        path = folder / name
        path.write_text(path.read_text().replace(" ", ", ").replace("/", "\\"))
    frames, _ = read(folder, GIVEN)
    assert len(frames) == 2


def test_images_of_one_time_are_said_to_be_left_out(tmp_path: Path, caplog) -> None:
    frames, source = read(tum_folder(tmp_path, ["7", "7", "7", "8"]), GIVEN)
    assert len(frames) == 2 and source.metadata["dropped"] == "4"
    assert "depth.txt: 2 images have the time of another one, and are left out" in caplog.text


@pytest.mark.parametrize(("factor", "is_said"), [(1, False), (5, True)])
def test_the_units_of_tum_without_its_lists_are_doubted(
    tmp_path: Path, factor: int, is_said: bool, caplog
) -> None:
    write_image(tmp_path / "a_color.png", FRAME.color)
    write_image(tmp_path / "a_depth.png", FRAME.depth_mm // 3 * factor)
    read(tmp_path, GIVEN)
    assert ("all depth is a multiple of 5 mm" in caplog.text) is is_said


@pytest.mark.parametrize(("per_meter", "is_said"), [(1, False), (1000, True)])
@pytest.mark.parametrize("form", ["7-Scenes", "TUM"])
def test_poses_in_millimeters_are_doubted(
    tmp_path: Path, form: str, per_meter: int, is_said: bool, caplog
) -> None:
    stamps = [f"{1 + number / 10:.1f}" for number in range(9)]
    places = [per_meter * np.array([0.05 * number, 0.5, 1.0]) for number in range(9)]
    if form == "TUM":
        folder = tum_folder(tmp_path, stamps)
        lines = [f"{stamp} {x} {y} {z} 0 0 0 1" for stamp, (x, y, z) in zip(stamps, places, strict=True)]
        (folder / "groundtruth.txt").write_text("\n".join(lines))
    else:
        folder = tmp_path / "seq-01"
        for number, place in enumerate(places):
            write_image(folder / f"frame-{number:06d}.color.png", FRAME.color)
            write_image(folder / f"frame-{number:06d}.depth.png", FRAME.depth_mm)
            pose = np.eye(4)
            pose[:3, 3] = place
            np.savetxt(folder / f"frame-{number:06d}.pose.txt", pose)
    frames, _ = read(folder, GIVEN)
    np.testing.assert_allclose(frames[-1].world_from_camera[:3, 3], places[-1])
    assert ("the camera's poses are 350 m apart: are they in millimeters?" in caplog.text) is is_said


@pytest.mark.parametrize("name", ["a.svo", "a.svo2"])
def test_a_recording_of_a_zed_is_known_by_its_name(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(bytes(range(1, 256)))
    with pytest.raises(
        RecordingFormatError, match=rf"{name}: cannot be replayed: a recording of a ZED; export"
    ):
        open_source(tmp_path / name)


def test_names_that_are_times_are_in_their_order(tmp_path: Path) -> None:
    # As str(time.time()) makes them: without zeros at the end.
    names = ["1700000000.25", "1700000000.3", "1700000000.333333", "1700000000.9", "1700000001.05"]
    for number, name in enumerate(names):
        write_image(tmp_path / "rgb" / f"{name}.png", FRAME.color)
        write_image(tmp_path / "depth" / f"{name}.png", scene(number).depth_mm)
    frames, _ = read(tmp_path, GIVEN)
    assert [frame.name for frame in frames] == names


@pytest.mark.parametrize(("late_s", "expected"), [(0.01, 20), (0.025, 10)])
def test_lists_whose_images_are_too_far_apart_are_said(
    tmp_path: Path, late_s: float, expected: int, caplog
) -> None:
    folder = tum_folder(tmp_path, [f"{1 + number / 15:.6f}" for number in range(20)])
    times = [1 + number / 15 + (late_s if number % 2 else 0.01) for number in range(20)]
    lines = [f"{time_s:.6f} depth/{number}.png" for number, time_s in enumerate(times)]
    (folder / "depth.txt").write_text("\n".join(lines))
    frames, _ = read(folder, GIVEN)
    assert len(frames) == expected
    said = "only 10 of 20 depth images have color within 0.02 s (--association-limit-s)"
    assert (said in caplog.text) is (expected == 10)


@pytest.mark.parametrize("kinds", ["depth", "depth color"])
@pytest.mark.parametrize(("late", "found"), [(0, 3), (2, 3), (None, 0)])
def test_labels_that_a_program_made_of_the_images_are_theirs(
    tmp_path: Path, kinds: str, late: int | None, found: int, caplog
) -> None:
    bag = Bag(tmp_path / "a.mcap")
    for number in range(3 + (late or 0)):
        stamp_ns = STAMP + number * 33_333_333
        bag.info("/c/camera_info", stamp_ns, "c", CAMERA)
        if number < 3:
            bag.image("/c/depth/image", stamp_ns, "c", scene(number).depth_mm, "16UC1")
            if "color" in kinds:
                bag.image("/c/color/image", stamp_ns, "c", scene(number).color, "rgb8")
        of = number - (late or 0)
        if of >= 0:
            own_ns = STAMP + of * 33_333_333 + (late is None) * 1_000_000
            log_ns = stamp_ns + 20_000_000
            bag.image("/c/labels", own_ns, "c", scene(of).labels, "16UC1", log_ns)
    frames, _ = read(bag.close())
    assert len(frames) == 3 and sum(frame.labels is not None for frame in frames) == found
    for number, frame in enumerate(frames[:found]):
        np.testing.assert_array_equal(frame.labels, scene(number).labels)
    assert ("3 label images have the time of no frame" in caplog.text) is (found == 0)


@pytest.mark.parametrize(("most", "found"), [(65_535, True), (65_536, False), (-1, False)])
def test_labels_of_32_bits_are_read_where_they_fit(tmp_path: Path, most: int, found: bool, caplog) -> None:
    # As Isaac Sim publishes them.
    labels = FRAME.labels.astype(np.int32)
    labels[0, 0] = most
    bag = Bag(tmp_path / "a.mcap")
    bag.camera("/c", FRAME, CAMERA, STAMP)
    bag.image("/c/instance_segmentation", STAMP, "c", labels, "32SC1")
    (frame,), _ = read(bag.close())
    assert (frame.labels is not None and np.array_equal(frame.labels, labels)) is found
    assert ("data: expected labels of 0 to 65535, got" in caplog.text) is not found


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("rgb_0001.png", "distance_to_camera_0001.npy"),  # Isaac Sim's
        ("frame.0001.color.jpg", "frame.0001.depth_meters.npy"),  # Hypersim's
        ("photo/25.jpg", "depth/25.png"),  # SceneNet RGB-D's
        ("point_7_view_0_domain_rgb.png", "point_7_view_0_domain_depth_euclidean.png"),  # Taskonomy's
    ],
)
def test_distances_along_the_rays_are_not_taken_for_depth(tmp_path: Path, color: str, depth: str) -> None:
    write_image(tmp_path / color, FRAME.color)
    (tmp_path / depth).parent.mkdir(exist_ok=True)
    if depth.endswith("png"):
        write_image(tmp_path / depth, FRAME.depth_mm)
    else:
        np.save(tmp_path / depth, FRAME.depth_mm / 1000)
    patterns = f"images:?color={tmp_path}/{color}&depth={tmp_path}/{depth}"
    for path in (patterns, tmp_path) if "photo" in color else (patterns,):
        with pytest.raises(RecordingFormatError, match=r"by its name the distance along each pixel's ray"):
            open_source(path, GIVEN)
    listed = {"file_path": color, "depth_file_path": depth}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [listed]}))
    with pytest.raises(RecordingFormatError, match=r"by its name the distance along each pixel's ray"):
        open_source(tmp_path, GIVEN)
    plane = tmp_path / f"distance_to_image_plane.{depth[-3:]}"
    (tmp_path / depth).rename(plane)
    (frame,), _ = read(f"images:?color={tmp_path}/{color}&depth={plane}", GIVEN)
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)


@pytest.mark.parametrize(
    ("topic", "is_depth"),
    [
        ("/airsim_node/a/front/DepthPerspective", False),
        ("/airsim_node/a/front/DepthPlanar", True),
        ("/ifm3d/radial_distance", False),
        ("/sim/distance_to_camera", False),
    ],
)
def test_topics_of_distances_along_the_rays_are_no_depth(tmp_path: Path, topic: str, is_depth: bool) -> None:
    bag = Bag(tmp_path / "a.mcap")
    bag.info(f"{topic}/camera_info", STAMP, "c", CAMERA)
    bag.image(topic, STAMP, "c", FRAME.depth_mm.astype(np.float32) / 1000, "32FC1")
    path = bag.close()
    for options in (None, SourceOptions(depth_topic=topic)):
        if is_depth:
            (frame,), _ = read(path, options)
            np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
            continue
        with pytest.raises(RecordingFormatError, match=rf"{topic}: by its name the distance along each"):
            open_source(path, options)


@pytest.mark.parametrize("folders", [False, True])
def test_the_unit_of_2d_3d_s_is_known_by_its_names(tmp_path: Path, folders: bool) -> None:
    name = "camera_0d600f92f8d14e288ddc590c32584a5a_conferenceRoom_1_frame_7_domain_"
    stored = np.where(FRAME.depth_mm == 0, 65_535, FRAME.depth_mm * 0.512).astype(np.uint16)
    for word, image in (("rgb", FRAME.color), ("depth", stored)):
        write_image((tmp_path / word if folders else tmp_path) / f"{name}{word}.png", image)
    (frame,), source = read(tmp_path, GIVEN)
    assert source.metadata["depth_unit"] == "512 per meter (2D-3D-S's own)"
    assert np.abs(frame.depth_mm.astype(int) - FRAME.depth_mm).max() <= 2


@pytest.mark.parametrize(
    ("names", "steps_ns"),
    [
        (["1700000000.25", "1700000000.3", "1700000001.05"], [50_000_000, 750_000_000]),
        (["1700000000250", "1700000000300", "1700000001050"], [50_000_000, 750_000_000]),
        (["1700000000250000", "1700000000300000", "1700000001050000"], [50_000_000, 750_000_000]),
        (["1700000000250000000", "1700000000300000000", "1700000001050000001"], [50_000_000, 750_000_001]),
        # Of other lengths, numbers of frames, and times that are not in all names.
        (["170000000025", "170000000030", "170000000105"], [33_333_333, 33_333_333]),
        (["1700000000", "1700000001", "1700000002"], [33_333_333, 33_333_333]),
        (["1700000000.25", "1700000000.3", "a"], [33_333_333, 33_333_333]),
    ],
)
@pytest.mark.parametrize("form", ["folders", "words first", "patterns"])
def test_names_that_are_times_are_the_frames_times(tmp_path: Path, names, steps_ns, form: str) -> None:
    for name in names:
        if form == "folders":
            write_image(tmp_path / "rgb" / f"{name}.png", FRAME.color)
            write_image(tmp_path / "depth" / f"{name}.png", FRAME.depth_mm)
        else:
            write_image(tmp_path / f"rgb_{name}.png", FRAME.color)
            write_image(tmp_path / f"depth_{name}.png", FRAME.depth_mm)
    patterns = f"images:?color={tmp_path}/rgb_*.png&depth={tmp_path}/depth_*.png"
    frames, _ = read(patterns if form == "patterns" else tmp_path, GIVEN)
    assert np.diff([frame.timestamp_ns for frame in frames]).tolist() == steps_ns
    if steps_ns[0] == 50_000_000:
        assert frames[0].timestamp_ns == STAMP + 250_000_000


@pytest.mark.parametrize("word", ["aligned_depth", "depth_aligned", "registered_depth", "depth_registered"])
@pytest.mark.parametrize("form", ["{word}/{number}.png", "{number}_{word}.png", "{word}_{number}.png"])
def test_depth_that_is_aligned_goes_before_that_beside_it(tmp_path: Path, word: str, form: str) -> None:
    for number in range(3):
        write_image(tmp_path / form.format(word="color", number=number), scene(number).color)
        write_image(tmp_path / form.format(word="depth", number=number), np.roll(FRAME.depth_mm, 5))
        if number < 2:
            # A frame without it is none, whatever other depth it has.
            write_image(tmp_path / form.format(word=word, number=number), scene(number).depth_mm)
    frames, _ = read(tmp_path, GIVEN)
    assert len(frames) == 2
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.depth_mm, scene(number).depth_mm)
        np.testing.assert_array_equal(frame.color, scene(number).color)


@pytest.mark.parametrize(
    ("depth", "focal"), [("aligned_depth/7.png", 50), ("7_depth_registered.png", 50), ("depth/7.png", 40)]
)
def test_depth_that_is_aligned_by_name_has_the_camera_of_color(
    tmp_path: Path, depth: str, focal: int, caplog
) -> None:
    write_image(tmp_path / ("color/7.png" if "/" in depth else "7_color.png"), FRAME.color)
    write_image(tmp_path / depth, FRAME.depth_mm)
    for word, fx in (("depth", 40), ("color", 50)):
        (tmp_path / f"intrinsic_{word}.txt").write_text(f"{fx} 0 31\n0 {fx} 23\n0 0 1\n")
    (frame,), _ = read(tmp_path)
    assert (frame.calibration.depth.fx, frame.calibration.color.fx) == (focal, 50)
    assert frame.calibration.is_registered is (focal == 50)
    assert ("registered to color, by its name" in caplog.text) is (focal == 50)
    # What the user gives counts.
    two = {word: {"fx": fx, "fy": fx, "cx": 31, "cy": 23} for word, fx in (("depth", 40), ("color", 50))}
    (tmp_path / "two.json").write_text(json.dumps(two))
    (frame,), _ = read(tmp_path, SourceOptions(calibration=tmp_path / "two.json"))
    assert frame.calibration.depth.fx == 40


#: What ROS calls compressed video, and the fields that say when it was taken.
VIDEOS = {
    "foxglove_msgs/msg/CompressedVideo": "builtin_interfaces/Time timestamp\nstring frame_id\n",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": "std_msgs/Header header\nint32 width\n",
    "sensor_msgs/msg/Temperature": "std_msgs/Header header\nfloat64 temperature\n",
}


@pytest.mark.parametrize("schema", VIDEOS)
def test_video_beside_depth_is_named_and_what_to_do(tmp_path: Path, schema: str, caplog) -> None:
    text = VIDEOS[schema] + "uint8[] data\n"
    for name, fields in (
        ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id"),
        ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec"),
    ):
        text += f"{'=' * 80}\nMSG: {name}\n{fields}\n"
    bag = Bag(tmp_path / "a.mcap")
    bag._schemas[schema] = bag._writer.register_msgdef(schema, text)
    bag.info("/c/depth/camera_info", STAMP, "c", CAMERA)
    bag.image("/c/depth/image", STAMP, "c", FRAME.depth_mm, "16UC1")
    bag.add("/c/color/video", schema, {"data": b"\0\0\0\1"}, STAMP)
    (frame,), _ = read(bag.close())
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    said = (
        f"/c/color/video ({schema.rpartition('/')[2]}): video is not decoded: record what image_transport's"
    )
    assert (said in caplog.text) is ("Temperature" not in schema)


@pytest.mark.parametrize("frame_ids", ["own", "same"])
@pytest.mark.parametrize("labelled", ["ab", "a", "b", ""])
@pytest.mark.parametrize("replayed", ["a", "b"])
def test_labels_are_those_of_the_camera_that_is_replayed(
    tmp_path: Path, replayed: str, labelled: str, frame_ids: str
) -> None:
    bag = Bag(tmp_path / "a.mcap")
    for number, name in enumerate("ab"):
        frame_id = name if frame_ids == "own" else "optical"
        bag.info(f"/{name}/camera_info", STAMP, frame_id, CAMERA)
        bag.image(f"/{name}/depth/image", STAMP, frame_id, FRAME.depth_mm, "16UC1")
        if name in labelled:
            bag.image(f"/{name}/labels", STAMP, frame_id, np.full((48, 64), number + 1, np.uint8), "8UC1")
    if labelled == "":
        # Of no camera by its name.
        bag.image("/net/labels", STAMP, "net", np.full((48, 64), 3, np.uint8), "8UC1")
    (frame,), _ = read(bag.close(), SourceOptions(depth_topic=f"/{replayed}/depth/image"))
    expected = 3 if labelled == "" else "ab".index(replayed) + 1 if replayed in labelled else None
    assert (None if frame.labels is None else set(np.unique(frame.labels))) == (expected and {expected})


@pytest.mark.parametrize(("name", "found"), [("{}_label", True), ("{:06d}", False), ("{}", True)])
def test_labels_whose_names_fit_no_frame_are_said(tmp_path: Path, name: str, found: bool, caplog) -> None:
    for number in range(2):
        write_image(tmp_path / "color" / f"{number}.png", FRAME.color)
        write_image(tmp_path / "depth" / f"{number}.png", FRAME.depth_mm)
        write_image(tmp_path / "label" / f"{name.format(number)}.png", FRAME.labels)
    frames, _ = read(tmp_path, GIVEN)
    assert [frame.labels is not None for frame in frames] == [found, found]
    said = "2 images are left out, since they lack their partner: 000000.png, 000001.png"
    assert (said in caplog.text) is not found


#: Fields of color, their numbers, and whether these are read.
CLOUD_COLORS = {
    "r g b of bytes": ([("r", "u1"), ("g", "u1"), ("b", "u1")], True),
    "b g r of bytes": ([("b", "u1"), ("g", "u1"), ("r", "u1")], True),
    "rgb of 8 bytes": ([("rgb", "f8")], True),
    "rgba": ([("rgba", "u4")], True),
    "r g b of floats": ([("r", "f4"), ("g", "f4"), ("b", "f4")], False),
    "brightness": ([("intensity", "f4")], False),
}


@pytest.mark.parametrize("form", ["PCD", "PointCloud2"])
@pytest.mark.parametrize("of", CLOUD_COLORS)
def test_the_colors_of_points_are_read_or_said_to_be_none(tmp_path: Path, of: str, form: str, caplog) -> None:
    columns, is_read = CLOUD_COLORS[of]
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), *columns]
    table = np.zeros((48, 64), np.dtype(fields))
    for place, name in enumerate("xyz"):
        table[name] = back_projected(FRAME)[..., place]
    red, green, blue = (FRAME.color[..., place].astype(np.uint32) for place in range(3))
    packed = red << 16 | green << 8 | blue
    for name, kind in columns:
        each = {"r": red, "g": green, "b": blue}.get(name, packed)
        table[name] = packed.view(np.float32) if kind == "f8" else each
    if form == "PCD":
        path = tmp_path / "a.pcd"
        head = ["VERSION 0.7", "FIELDS " + " ".join(name for name, _ in fields)]
        head.append("SIZE " + " ".join(kind[1] for _, kind in fields))
        head.append("TYPE " + " ".join(kind[0].upper() for _, kind in fields))
        head += ["WIDTH 64", "HEIGHT 48", "DATA binary", ""]
        path.write_bytes("\n".join(head).encode() + table.tobytes())
    else:
        code = {"u1": 2, "u4": 6, "f4": 7, "f8": 8}
        listed = [
            {"name": name, "offset": table.dtype.fields[name][1], "datatype": code[kind], "count": 1}
            for name, kind in fields
        ]
        size = table.dtype.itemsize
        message = {"header": ros.header(STAMP, "c"), "height": 48, "width": 64, "fields": listed}
        message |= {"point_step": size, "row_step": 64 * size, "data": table.tobytes()}
        bag = Bag(tmp_path / "a.mcap")
        bag.add("/c/points", ros.POINT_CLOUD, message | {"is_bigendian": False, "is_dense": False}, STAMP)
        path = bag.close()
    (frame,), _ = read(path)
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    assert np.array_equal(frame.color, FRAME.color) is is_read
    assert (frame.color == 128).all() or is_read
    assert ("gray" in caplog.text) is not is_read


@pytest.mark.parametrize(
    ("turn_deg", "frame_id", "is_said"), [(0, "c", False), (3, "c", True), (3, "d", False)]
)
def test_points_that_lie_on_another_camera_than_their_camera_info_are_said(
    tmp_path: Path, turn_deg: float, frame_id: str, is_said: bool, caplog
) -> None:
    # Of a distant flat thing in the middle of the image a turn is no more than a shift of the pixels.
    v, u = np.mgrid[:48, :64]
    rays = np.dstack([(u - 31.5) / 520, (v - 23.5) / 520, np.ones((48, 64))])
    turn = np.array([[1, 0, 0], [0, 1, -np.radians(turn_deg)], [0, np.radians(turn_deg), 1]])
    points = (2 * rays @ turn.T).astype("<f4")
    fields = [{"name": name, "offset": 4 * n, "datatype": 7, "count": 1} for n, name in enumerate("xyz")]
    message = {"header": ros.header(STAMP, "c"), "height": 48, "width": 64, "fields": fields}
    message |= {"point_step": 12, "row_step": 12 * 64, "data": points.tobytes()}
    bag = Bag(tmp_path / "a.mcap")
    bag.add("/c/points", ros.POINT_CLOUD, message | {"is_bigendian": False, "is_dense": False}, STAMP)
    bag.info("/c/camera_info", STAMP, frame_id, Intrinsics(64, 48, 520, 520, 31.5, 23.5))
    frames, _ = read(bag.close())
    assert len(frames) == 1
    assert ("/c/camera_info states [520.0, 520.0, 31.5, 23.5]: were they turned" in caplog.text) is is_said
