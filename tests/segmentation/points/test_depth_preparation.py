from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.segmentation.config import DepthConfig
from nurbseg.segmentation.points.depth_preparation import DepthPreparation

SIZE = (40, 50)
NOISE_PER_M = 2.5e-3


def frame_of(depth_mm: NDArray[np.uint16], index: int = 0) -> RGBDFrame:
    height, width = depth_mm.shape
    camera = Calibration.registered(Intrinsics(width, height, 60.0, 60.0, width / 2, height / 2))
    return RGBDFrame(index, index, depth_mm.copy(), np.zeros((height, width, 3), np.uint8), camera)


def prepared(depth_mm: NDArray[np.uint16], **settings: object) -> NDArray[np.uint16]:
    preparation = DepthPreparation(DepthConfig(**settings), NOISE_PER_M)  # type: ignore[arg-type]
    return preparation.prepared(frame_of(depth_mm)).depth_mm


@pytest.fixture
def noisy() -> NDArray[np.uint16]:
    """A wall at 2 m behind a plate at 1 m, with the sensor's noise and some pixels without depth."""
    rng = np.random.default_rng(0)
    inverse = np.full(SIZE, 0.5)
    inverse[10:30, 20:40] = 1.0
    depth = np.rint(1e3 / (inverse + rng.normal(0.0, NOISE_PER_M, SIZE))).astype(np.uint16)
    depth[rng.random(SIZE) < 0.05] = 0
    return depth


def test_without_a_wish_the_frame_itself_comes_back(noisy: NDArray[np.uint16]) -> None:
    frame = frame_of(noisy)
    assert DepthPreparation(DepthConfig(), NOISE_PER_M).prepared(frame) is frame


def test_what_is_out_of_range_has_no_depth() -> None:
    depth = np.tile(np.array([0, 499, 500, 1500, 1501], np.uint16), (40, 10))
    found = prepared(depth, range_min_m=0.5, range_max_m=1.5)
    assert_array_equal(found, np.tile(np.array([0, 0, 500, 1500, 0], np.uint16), (40, 10)))


def test_what_is_outside_the_crop_has_no_depth(noisy: NDArray[np.uint16]) -> None:
    found = prepared(noisy, crop=(20, 10, 5, 20))
    assert_array_equal(found[10:30, 20:25], noisy[10:30, 20:25])
    assert np.count_nonzero(found) == np.count_nonzero(noisy[10:30, 20:25])
    assert_array_equal(prepared(noisy, crop=(20, 10, 500, 500))[10:, 20:], noisy[10:, 20:])


def test_a_crop_outside_of_the_image_is_named() -> None:
    DepthConfig(crop=(49, 39, 10, 10)).check_crop(50, 40)
    for crop in ((50, 0, 10, 10), (0, 40, 10, 10)):
        with pytest.raises(ValueError, match=r"crop: .* is outside of a depth image of 50x40"):
            DepthConfig(crop=crop).check_crop(50, 40)


@pytest.mark.parametrize("smoothing", ["median", "bilateral"])
def test_smoothing_takes_noise_away_and_keeps_edges_and_holes(
    smoothing: str, noisy: NDArray[np.uint16]
) -> None:
    found = prepared(noisy, smoothing=smoothing)
    assert_array_equal(found == 0, noisy == 0)
    # The wall and the plate, but for the corners that a median rounds off.
    for part, expected in ((np.s_[:, :18], 500.0), (np.s_[12:28, 22:38], 1000.0)):
        valid = noisy[part] > 0
        errors = [np.std((1e6 / each[part][valid]) - expected) for each in (noisy, found)]
        assert errors[1] < 0.75 * errors[0]
    assert not ((found > 1100) & (found < 1800)).any()


@pytest.mark.parametrize("smoothing", ["median", "bilateral"])
def test_pixels_next_to_a_hole_are_smoothed_by_those_with_depth(smoothing: str) -> None:
    inverse = 0.5 + np.random.default_rng(2).normal(0.0, NOISE_PER_M, (400, 20))
    depth = np.rint(1e3 / inverse).astype(np.uint16)
    depth[:, 10:] = 0
    beside = 1e3 / prepared(depth, smoothing=smoothing)[:, 9]
    assert abs(beside.mean() - 0.5) < 0.2 * NOISE_PER_M
    assert beside.std() < 0.75 * NOISE_PER_M


def test_an_average_follows_what_changes_slowly() -> None:
    preparation = DepthPreparation(DepthConfig(average_frames=4), NOISE_PER_M)
    for index in range(40):
        depth = np.full(SIZE, round(1e3 / (0.5 + 4e-4 * index)), np.uint16)
        found = preparation.prepared(frame_of(depth, index)).depth_mm
        # A mean that loses a quarter with each frame is three frames behind.
        assert np.abs(1e3 / found - 1e3 / depth).max() < 3.5 * 4e-4


def test_a_still_pixel_is_averaged_until_something_comes_before_it() -> None:
    rng = np.random.default_rng(1)
    preparation = DepthPreparation(DepthConfig(average_frames=8), NOISE_PER_M)
    inverse = np.full(SIZE, 0.5)
    shown, means = [], []
    for index in range(30):
        if index == 20:
            inverse[:, 25:] = 1.0
        shown.append(np.rint(1e3 / (inverse + rng.uniform(-0.002, 0.002, SIZE))).astype(np.uint16))
        shown[-1][0, 0] = 0 if index == 25 else shown[-1][0, 0]
        means.append(preparation.prepared(frame_of(shown[-1], index)).depth_mm)
    # The first eight as a plain mean of inverse depths.
    plain = 1e3 / np.mean([1e3 / each for each in shown[:8]], axis=0)
    assert np.abs(means[7] - plain).max() <= 1.0
    assert_array_equal(means[20][:, 25:], shown[20][:, 25:])
    assert np.std(means[19][:, :25]) < 0.5 * np.std(shown[19][:, :25].astype(float))
    assert means[25][0, 0] == 0 and means[26][0, 0] == shown[26][0, 0]


def test_holes_are_filled_by_the_nearest_depth_as_far_as_wanted() -> None:
    depth = np.zeros((5, 12), np.uint16)
    depth[:, 0], depth[:, 11] = 800, 1200
    expected = [800, 800, 800, 800, 0, 0, 0, 0, 1200, 1200, 1200, 1200]
    assert_array_equal(prepared(depth, holes_px=3), np.tile(np.array(expected, np.uint16), (5, 1)))
    assert not prepared(np.zeros(SIZE, np.uint16), holes_px=3).any()


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"range_min_m": 2.0, "range_max_m": 1.0}, "range_max_m: expected more than range_min_m"),
        ({"crop": (0, 0, 0, 10)}, "crop: expected left, top, width and height"),
        ({"crop": (-1, 0, 5, 10)}, "crop: expected left, top, width and height"),
        ({"average_frames": 0}, "average_frames: expected a whole number, at least 1"),
    ],
)
def test_settings_that_leave_nothing_are_refused(settings: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        DepthConfig(**settings)  # type: ignore[arg-type]
