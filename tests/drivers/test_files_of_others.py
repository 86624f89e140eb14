"""Files as other programs and systems leave them: stray files, other units, layouts and encodings."""

from pathlib import Path

import numpy as np
import pytest
from recorded_scene import CAMERA, scene, write_image
from robot_bag import Bag, encoded

from nurbseg.drivers import CalibrationError, RecordingFormatError, SourceOptions, open_source

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


def scannet_folder(folder: Path) -> Path:
    for name in ("9", "10"):
        write_image(folder / "color" / f"{name}.png", FRAME.color)
        write_image(folder / "depth" / f"{name}.png", FRAME.depth_mm)
    (folder / "intrinsics.txt").write_text("50 0 31.5 0\n0 50 23.5 0\n0 0 1 0\n0 0 0 1\n")
    return folder


def split_folder(folder: Path) -> Path:
    for part in (0, 1):
        bag = Bag(folder / f"b_{part}.mcap")
        bag.camera("/c", FRAME, CAMERA, STAMP + part * 33_333_333)
        bag.close()
    return folder


@pytest.mark.parametrize("make", [scannet_folder, split_folder])
def test_the_hidden_files_of_macos_are_no_part_of_a_recording(tmp_path: Path, make) -> None:
    frames, source = read(copied_by_macos(make(tmp_path)))
    assert len(frames) == 2 and "damaged" not in source.metadata
    for frame in frames:
        np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)


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
    said = "only 10 of 20 depth images have color within 0.02 s (--set association_limit_s=S)"
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
