"""The order of a recording's messages, and the clocks that pair its images and time its frames."""

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import IndexType
from mcap_ros2.writer import Writer as Ros2Writer
from recorded_scene import CAMERA, INTERVAL_NS, scene
from robot_bag import Bag

from nurbseg.drivers import RGBDFrame, open_source
from nurbseg.drivers.mcap import ros_messages as ros

START_NS = 1_700_000_000_000_000_000
FRAMES = 40


def numbered(index: int) -> RGBDFrame:
    return scene(index % 20)


def steps(source: list[RGBDFrame]) -> np.ndarray:
    return np.diff([frame.timestamp_ns for frame in source])


def check_pairs(frames: list[RGBDFrame], order: list[int] | None = None) -> None:
    """Check that each frame has the depth and color that were taken together."""
    for frame, index in zip(frames, order or range(FRAMES), strict=True):
        np.testing.assert_array_equal(frame.depth_mm, numbered(index).depth_mm)
        np.testing.assert_array_equal(frame.color, numbered(index).color)


def write(
    path: Path,
    depth_ns: Callable[[int], int],
    color_ns: Callable[[int], int] | None = None,
    log_ns: Callable[[int], int] = lambda index: START_NS + index * INTERVAL_NS,
) -> Path:
    bag = Bag(path)
    for index in range(FRAMES):
        message = ros.camera_info_message(0, "optical", CAMERA)
        log = log_ns(index)
        bag.add("/c/camera_info", ros.CAMERA_INFO, message, 0, log)
        bag.image("/c/depth/image", depth_ns(index), "optical", numbered(index).depth_mm, "16UC1", log)
        # Logged a little later, as it is larger.
        stamp = (color_ns or depth_ns)(index)
        bag.image("/c/color/image", stamp, "optical", numbered(index).color, "rgb8", log + 3_000_000)
    return bag.close()


def right(index: int) -> int:
    return START_NS + index * INTERVAL_NS


@pytest.mark.parametrize(
    ("depth_ns", "color_ns", "said"),
    [
        (lambda n: 0, None, "the stamps of depth are 0"),
        (right, lambda n: 0, "the stamps of color are 0"),
        (lambda n: START_NS, None, "the stamps of depth do not change"),
        (lambda n: 12_000_000_000 + n * INTERVAL_NS, right, "depth and color have different clocks"),
        (lambda n: 12_000_000_000 + 60 * n * INTERVAL_NS, None, "stamps run 60 times as fast as log times"),
    ],
)
def test_where_stamps_make_no_sense_the_log_counts(
    tmp_path: Path, depth_ns, color_ns, said: str, caplog
) -> None:
    with open_source(write(tmp_path / "bag.mcap", depth_ns, color_ns)) as source:
        frames = list(source)
        assert said in source.metadata["clock"]
    assert said in caplog.text
    check_pairs(frames)
    assert set(steps(frames)) == {INTERVAL_NS}


@pytest.mark.parametrize(
    "wrong_ns",
    [0, -5_000_000_000, START_NS + 31_000_000_000_000_000, START_NS - 31_000_000_000_000_000],
)
def test_single_stamps_that_are_wrong_cost_no_frame(tmp_path: Path, wrong_ns: int, caplog) -> None:
    path = write(tmp_path / "bag.mcap", lambda n: wrong_ns if n in (0, 7, 8, 30) else right(n))
    with open_source(path) as source:
        frames = list(source)
        assert source.metadata["stamps_replaced"] == "8"
    check_pairs(frames)
    assert steps(frames) == pytest.approx(INTERVAL_NS, abs=3_000_001)
    assert caplog.text.count("is wrong; the log's time stands in") == 1


def test_stamps_far_from_the_log_are_as_good_as_any(tmp_path: Path, caplog) -> None:
    path = write(tmp_path / "bag.mcap", lambda n: 12_000_000_000 + n * INTERVAL_NS)
    with open_source(path) as source:
        assert [frame.timestamp_ns for frame in source] == [
            12_000_000_000 + n * INTERVAL_NS for n in range(FRAMES)
        ]
    assert caplog.text == ""


def test_a_fast_conversion_does_not_replace_stamps(tmp_path: Path) -> None:
    path = write(tmp_path / "bag.mcap", right, log_ns=lambda n: START_NS + n * 3_300_000)
    with open_source(path) as source:
        frames = list(source)
        assert "paired by stamps, timed by stamps (stamps run 10.1 times as fast" in source.metadata["clock"]
    check_pairs(frames)
    assert [frame.timestamp_ns for frame in frames] == [right(n) for n in range(FRAMES)]


@pytest.mark.parametrize("color_late_ns", [0, 4_000_000, -4_000_000])
@pytest.mark.parametrize("log_goes_back", [True, False])
def test_a_clock_that_is_set_back_costs_no_frame(
    tmp_path: Path, color_late_ns: int, log_goes_back: bool
) -> None:
    def set_back(index: int) -> int:
        return right(index) - (5_000_000_000 if index >= 20 else 0)

    def log_ns(index: int) -> int:
        return (set_back if log_goes_back else right)(index) + 9_000_000

    path = write(tmp_path / "bag.mcap", set_back, lambda n: set_back(n) + color_late_ns, log_ns)
    with open_source(path) as source:
        frames = list(source)
        assert source.dropped == 0
    check_pairs(frames)


@pytest.mark.parametrize("jump_s", [3600, -3600, 5, -5])
@pytest.mark.parametrize("first", [1, 5, 15, 20, 38])
def test_a_clock_that_is_set_soon_costs_no_frame(tmp_path: Path, jump_s: int, first: int) -> None:
    def is_set(index: int) -> int:
        return right(index) + (jump_s * 1_000_000_000 if index >= first else 0)

    with open_source(write(tmp_path / "bag.mcap", is_set)) as source:
        frames = list(source)
        assert source.dropped == 0
    check_pairs(frames)


def test_a_clock_that_is_set_while_a_camera_is_slow_to_begin_costs_no_frame(tmp_path: Path) -> None:
    """What is compared of color, from its first image on, and of depth is set at other places."""

    def is_set(index: int) -> int:
        return right(index) + (3_600_000_000_000 if index >= 45 else 0)

    bag = Bag(tmp_path / "bag.mcap")
    bag.add("/c/camera_info", ros.CAMERA_INFO, ros.camera_info_message(0, "optical", CAMERA), 0, right(0))
    for index in range(120):
        pixels = numbered(index)
        bag.image("/c/color/image", is_set(index), "optical", pixels.color, "rgb8", right(index))
        if index >= 10:
            bag.image("/c/depth/image", is_set(index), "optical", pixels.depth_mm, "16UC1", right(index))
    with open_source(bag.close()) as source:
        assert len(list(source)) == 110


def test_a_bag_that_was_looped_is_replayed_as_often(tmp_path: Path) -> None:
    def looped(index: int) -> int:
        return right(index % 10)

    with open_source(write(tmp_path / "bag.mcap", looped, log_ns=looped)) as source:
        frames = list(source)
    assert len(frames) == FRAMES
    assert np.count_nonzero(steps(frames) < 0) in (0, 3)


def in_order(path: Path, order: list[tuple[str, int]], *, log: bool = True, **options: object) -> Path:
    """Write the messages of FRAMES frames in this order, of topic and number."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream, chunk_size=20_000)
        for name, value in options.items():
            setattr(writer._writer, f"_Writer__{name}", value)
        schemas = {name: writer.register_msgdef(name, text) for name, text in ros.DEFINITIONS.items()}
        for topic, index in order:
            stamp, frame = right(index), numbered(index)
            schema = ros.IMAGE
            if topic == "/c/camera_info":
                message, schema = ros.camera_info_message(stamp, "optical", CAMERA), ros.CAMERA_INFO
            elif topic == "/c/depth":
                message = ros.image_message(stamp, "optical", frame.depth_mm, "16UC1")
            else:
                message = ros.image_message(stamp, "optical", frame.color, "rgb8")
            log_ns = stamp if log else 0
            writer.write_message(topic, schemas[schema], message, log_time=log_ns, publish_time=log_ns)
        writer.finish()
    return path


TOPICS = ("/c/camera_info", "/c/depth", "/c/color")
BY_TOPIC = [(topic, index) for topic in TOPICS for index in range(FRAMES)]
BY_TIME = [(topic, index) for index in range(FRAMES) for topic in TOPICS]
SHUFFLED = random.Random(1).sample(BY_TIME, len(BY_TIME))
HALVES = [*BY_TIME[len(BY_TIME) // 2 :], *BY_TIME[: len(BY_TIME) // 2]]


@pytest.mark.parametrize("order", [BY_TIME, BY_TOPIC, BY_TOPIC[::-1], SHUFFLED, HALVES])
@pytest.mark.parametrize(
    "options",
    [{}, {"index_types": IndexType.NONE}, {"use_chunking": False}],
    ids=["indexed", "none", "unchunked"],
)
def test_messages_are_read_in_the_order_of_time(tmp_path: Path, order, options) -> None:
    path = in_order(tmp_path / "bag.mcap", order, **options)
    with open_source(path) as source:
        frames = list(source)
        assert source.dropped == 0
        check_pairs(frames)
        assert [frame.timestamp_ns for frame in frames] == [right(n) for n in range(FRAMES)]
        for index in (17, 3, 38, 11):
            source.seek(index)
            again = source.read()
            assert again.index == index
            np.testing.assert_array_equal(again.color, numbered(index).color)


def test_without_times_of_the_log_stamps_give_the_order(tmp_path: Path) -> None:
    with open_source(in_order(tmp_path / "bag.mcap", BY_TOPIC, log=False)) as source:
        check_pairs(list(source))
        assert "in the order of their stamps" in source.metadata["order"]


def test_what_was_cut_off_is_replayed_as_far_as_both_images_go(tmp_path: Path) -> None:
    path = in_order(tmp_path / "bag.mcap", BY_TOPIC)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 2 // 3])
    with open_source(path) as source:
        frames = list(source)
    assert 5 < len(frames) < FRAMES
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, numbered(index).color)
        np.testing.assert_array_equal(frame.depth_mm, numbered(index).depth_mm)


def test_seeking_among_stamps_closer_than_the_limit_finds_the_same_frames(tmp_path: Path) -> None:
    # The images of the frame before are within the limit, too, and wait while a place is remembered.
    bag = Bag(tmp_path / "bag.mcap")
    bag.info("/c/camera_info", START_NS, "optical", CAMERA)
    for index in range(FRAMES):
        stamp = START_NS + index * 7_000_000
        bag.image("/c/depth/image", stamp, "optical", numbered(index).depth_mm, "16UC1", stamp)
        late = stamp + 3_000_000
        bag.image("/c/color/image", late, "optical", numbered(index).color, "rgb8", late)
    with open_source(bag.close()) as source:
        frames = list(source)
        assert len(frames) == FRAMES
        check_pairs(frames)
        for index in (25, 12, 31, 11, 38, 21):
            source.seek(index)
            again = source.read()
            assert (again.index, again.timestamp_ns) == (index, frames[index].timestamp_ns)
            np.testing.assert_array_equal(again.color, numbered(index).color)
            np.testing.assert_array_equal(again.depth_mm, numbered(index).depth_mm)


@pytest.mark.parametrize("late", ["depth", "color"])
def test_images_that_are_logged_seconds_late_find_their_partners(tmp_path: Path, late: str) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for index in range(200):
        frame, stamp = numbered(index), right(index)
        log = {kind: stamp + (4_000_000_000 if kind == late else 2_000_000) for kind in ("depth", "color")}
        bag.info("/c/camera_info", stamp, "optical", CAMERA)
        bag.image("/c/depth/image", stamp, "optical", frame.depth_mm, "16UC1", log["depth"])
        bag.image("/c/color/image", stamp, "optical", frame.color, "rgb8", log["color"])
    with open_source(bag.close()) as source:
        frames = list(source)
        assert source.dropped == 0
    assert [frame.timestamp_ns for frame in frames] == [right(n) for n in range(200)]


def test_stamps_are_read_in_the_byte_order_of_the_message() -> None:
    little = b"\0\1\0\0" + (1_700_000_001).to_bytes(4, "little") + (500_000_007).to_bytes(4, "little")
    big = b"\0\0\0\0" + (1_700_000_001).to_bytes(4, "big") + (500_000_007).to_bytes(4, "big")
    assert ros.stamp_ns(little) == ros.stamp_ns(big) == 1_700_000_001_500_000_007
    assert ros.stamp_fields(big) == (1_700_000_001, 500_000_007)
