"""The stamps of a recording's messages: which images are a pair, and what counts where they make no sense."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recorded_scene import CAMERA, INTERVAL_NS, scene
from robot_bag import Bag

from nurbseg.drivers import RGBDFrame, SourceOptions, open_source

START_NS = scene(0).timestamp_ns
FRAMES = 40
LIMIT = SourceOptions(association_limit_s=20e-6)


def right(index: int) -> int:
    return START_NS + index * INTERVAL_NS


def write(
    path: Path,
    depth_ns: Callable[[int], int] = right,
    color_ns: Callable[[int], int] | None = None,
    log_ns: Callable[[int], int] = right,
    late_ns: int = 3_000_000,
    count: int = FRAMES,
) -> Path:
    """Write frames whose color is logged a little later, as it is larger."""
    bag = Bag(path / "bag.mcap")
    for index in range(count):
        pixels, log = scene(index % 20), log_ns(index)
        bag.info("/c/camera_info", 0, "c", CAMERA, log)
        bag.image("/c/depth/image", depth_ns(index), "c", pixels.depth_mm, "16UC1", log)
        stamp = (color_ns or depth_ns)(index)
        bag.image("/c/color/image", stamp, "c", pixels.color, "rgb8", log + late_ns)
    return bag.close()


def check_pairs(frames: list[RGBDFrame]) -> None:
    """Check that each frame has the depth and color that were taken together."""
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.depth_mm, scene(index % 20).depth_mm)
        np.testing.assert_array_equal(frame.color, scene(index % 20).color)
    assert len(frames) == FRAMES


@pytest.mark.parametrize(
    ("depth_ns", "color_ns"), [(lambda n: 0, None), (right, lambda n: 0), (lambda n: START_NS, None)]
)
def test_where_stamps_are_zero_or_stand_still_the_log_counts(tmp_path, depth_ns, color_ns, caplog):
    with open_source(write(tmp_path, depth_ns, color_ns)) as source:
        frames = list(source)
    check_pairs(frames)
    assert "the stamps of" in caplog.text
    assert set(np.diff([frame.timestamp_ns for frame in frames])) == {INTERVAL_NS}


@pytest.mark.parametrize("log_goes_back", [True, False])
@pytest.mark.parametrize("color_late_ns", [0, 4_000_000, -4_000_000])
def test_a_clock_that_is_set_back_costs_no_frame(tmp_path, color_late_ns, log_goes_back):
    def set_back(index: int) -> int:
        return right(index) - (5_000_000_000 if index >= 20 else 0)

    def log_ns(index: int) -> int:
        return (set_back if log_goes_back else right)(index) + 9_000_000

    # More than wait for a partner.
    late = write(tmp_path, set_back, lambda n: set_back(n) + color_late_ns, log_ns, count=120)
    with open_source(late) as source:
        frames = list(source)
        assert source.dropped == 0
        # By the log, where only the stamps went back.
        stamps = [frame.timestamp_ns for frame in frames]
        assert (stamps == sorted(stamps)) is not log_goes_back
    # In whichever order.
    taken = {scene(n).depth_mm.tobytes(): scene(n).color for n in range(20)}
    assert len(frames) == 120
    for frame in frames:
        np.testing.assert_array_equal(frame.color, taken[frame.depth_mm.tobytes()])


def test_stamps_far_from_the_log_are_as_good_as_any(tmp_path: Path, caplog) -> None:
    with open_source(write(tmp_path, lambda n: right(n) - START_NS + 12_000_000_000)) as source:
        stamps = [frame.timestamp_ns for frame in source]
    assert stamps == [12_000_000_000 + n * INTERVAL_NS for n in range(FRAMES)]
    assert caplog.text == ""


@pytest.mark.parametrize("late_s", [-4, 4])
def test_images_that_are_logged_seconds_late_find_their_partners(tmp_path: Path, late_s: int) -> None:
    path = write(tmp_path, log_ns=lambda n: right(n) + 5_000_000_000, late_ns=late_s * 1_000_000_000)
    with open_source(path) as source:
        frames = list(source)
        assert source.dropped == 0
    check_pairs(frames)


def test_seeking_among_stamps_closer_than_the_limit_finds_the_same_frames(tmp_path: Path) -> None:
    # The images of the frame before are within the limit, too, and wait while a place is remembered.
    def near(index: int) -> int:
        return START_NS + index * 7_000_000

    with open_source(write(tmp_path, near, lambda n: near(n) + 3_000_000, near)) as source:
        frames = list(source)
        check_pairs(frames)
        for index in (25, 12, 31, 11, 38, 21):
            source.seek(index)
            again = source.read()
            assert (again.index, again.timestamp_ns) == (index, frames[index].timestamp_ns)
            np.testing.assert_array_equal(again.color, frames[index].color)


#: Stamps of depth and of color in microseconds; the pairs, and how many images are left over.
PAIRS: list[tuple[list[int], list[int], list[tuple[int, int]], int]] = [
    ([100], [100], [(100, 100)], 0),
    ([100], [0, 30, 100], [(100, 100)], 2),
    # The nearer of two colors, and of two depths; the others have no partner.
    ([100, 140], [90, 104], [(100, 104)], 2),
    ([100, 110, 150], [108, 150], [(110, 108), (150, 150)], 1),
    # One later than the limit.
    ([100, 200], [121, 200], [(200, 200)], 2),
    ([100, 200], [120, 200], [(100, 120), (200, 200)], 0),
    # What waits at the end.
    ([100, 180], [90], [(100, 90)], 1),
    ([100, 180], [90, 260, 290], [(100, 90)], 3),
]


@pytest.mark.parametrize(("depths", "colors", "pairs", "dropped"), PAIRS)
def test_the_nearest_images_within_the_limit_are_a_pair(tmp_path, depths, colors, pairs, dropped, caplog):
    bag = Bag(tmp_path / "bag.mcap")
    images = [("depth", stamp) for stamp in depths] + [("color", stamp) for stamp in colors]
    bag.info("/c/camera_info", START_NS, "c", CAMERA)
    for kind, stamp in sorted(images, key=lambda image: image[1]):
        at = START_NS + stamp * 1000
        if kind == "depth":
            bag.image("/c/depth/image", at, "c", np.full((48, 64), 1000 + stamp, np.uint16), "16UC1", at)
        else:
            bag.image("/c/color/image", at, "c", np.full((48, 64, 3), stamp % 256, np.uint8), "rgb8", at)
    with open_source(bag.close(), LIMIT) as source:
        frames = list(source)
        assert source.metadata["dropped"] == str(source.dropped) == str(dropped)
    assert [(int(f.depth_mm[0, 0]) - 1000, int(f.color[0, 0, 0])) for f in frames] == [
        (depth, color % 256) for depth, color in pairs
    ]
    assert [frame.timestamp_ns for frame in frames] == [START_NS + depth * 1000 for depth, _ in pairs]
    assert (f"{dropped} images had no partner" in caplog.text) is (dropped > 0)
