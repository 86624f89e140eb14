"""The TUM RGB-D layout: lists, association in time, depth scale."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recorded_scene import scenes, write_tum

from nurbseg.drivers import CalibrationError, RecordingFormatError, SourceOptions, open_source
from nurbseg.drivers.datasets.tum import associate


def test_depth_is_scaled_and_time_is_the_depth_images(tmp_path: Path) -> None:
    frames = scenes(3)
    with open_source(write_tum(tmp_path, frames)) as source:
        for one, other in zip(frames, source, strict=True):
            np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
            np.testing.assert_array_equal(one.color, other.color)
            assert abs(one.timestamp_ns - other.timestamp_ns) < 1000
        assert source.metadata["dropped"] == "0"


def test_images_whose_partner_is_missing_are_dropped_and_counted(tmp_path: Path) -> None:
    write_tum(tmp_path, scenes(6))
    for name, line in (("rgb.txt", 2), ("rgb.txt", 4), ("depth.txt", 6)):
        lines = (tmp_path / name).read_text().splitlines()
        lines[line] = ""
        (tmp_path / name).write_text("\n".join(lines))
    with open_source(tmp_path) as source:
        assert source.metadata["dropped"] == "3"
        assert len(list(source)) == 3


def test_the_association_limit_is_the_users(tmp_path: Path) -> None:
    write_tum(tmp_path, scenes(3))
    with pytest.raises(RecordingFormatError, match=r"none of 3 color and 3 depth images are within 0\.001 s"):
        open_source(tmp_path, SourceOptions(association_limit_s=0.001))


def test_the_nearest_are_paired_even_if_another_comes_first() -> None:
    assert associate([0, 30], [12, 28], 20) == [(0, 0), (1, 1)]
    assert associate([0, 10], [9], 20) == [(1, 0)]
    assert associate([5], [0, 4, 9], 20) == [(0, 1)]
    assert associate([0], [21], 20) == []
    assert associate([], [1], 20) == []


times = st.lists(st.integers(0, 1000), max_size=25).map(sorted)


@given(times, times, st.integers(0, 60))
def test_pairs_are_near_used_once_and_none_nearer_is_left(
    first: list[int], second: list[int], limit: int
) -> None:
    pairs = associate(first, second, limit)
    assert all(abs(first[a] - second[b]) <= limit for a, b in pairs)
    assert len({a for a, _ in pairs}) == len({b for _, b in pairs}) == len(pairs)
    taken_a = {a: abs(first[a] - second[b]) for a, b in pairs}
    taken_b = {b: abs(first[a] - second[b]) for a, b in pairs}
    # By the brute force of all pairs: each near one was beaten by a pair at least as near.
    for a, moment in enumerate(first):
        for b, other in enumerate(second):
            gap = abs(moment - other)
            if gap <= limit:
                assert min(taken_a.get(a, limit + 1), taken_b.get(b, limit + 1)) <= gap


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("notanumber rgb/a.png", "line 2"),
        ("1.5", "line 2"),
        ("nan rgb/a.png", "line 2"),
        ("inf x.png", "line 2"),
    ],
)
def test_a_damaged_list_is_named_with_the_line(tmp_path: Path, line: str, text: str) -> None:
    write_tum(tmp_path, scenes(1))
    (tmp_path / "rgb.txt").write_text(f"# color\n{line}\n")
    with pytest.raises(RecordingFormatError, match=rf"rgb\.txt: {text}: expected 'seconds file'"):
        open_source(tmp_path)


def test_no_calibration_is_an_error_that_says_how_to_give_one(tmp_path: Path) -> None:
    write_tum(tmp_path, scenes(1))
    (tmp_path / "camera.toml").unlink()
    with pytest.raises(CalibrationError, match="--intrinsics"):
        open_source(tmp_path)


def test_listed_images_that_are_not_there_are_named(tmp_path: Path) -> None:
    write_tum(tmp_path, scenes(2))
    for path in (tmp_path / "depth").iterdir():
        path.unlink()
    with pytest.raises(RecordingFormatError, match=r"none of the 2 frames.*depth/.*cannot be read"):
        open_source(tmp_path)


def test_microseconds_since_1970_are_kept_to_the_nanosecond(tmp_path: Path) -> None:
    write_tum(tmp_path, scenes(1))
    lines = (tmp_path / "depth.txt").read_text().split()
    name = lines[-1]
    (tmp_path / "depth.txt").write_text(f"1305031102.006368123 {name}\n")
    color = (tmp_path / "rgb.txt").read_text().split()[-1]
    (tmp_path / "rgb.txt").write_text(f"1305031102.0 {color}\n")
    with open_source(tmp_path) as source:
        assert source.read().timestamp_ns == 1305031102006368123


@pytest.mark.parametrize("stamp", ["2147483648", "99999999999", "1663251800046333333000"])
def test_stamps_of_no_unit_are_refused(tmp_path: Path, stamp: str) -> None:
    write_tum(tmp_path, scenes(1))
    (tmp_path / "rgb.txt").write_text(f"{stamp} rgb/0.png\n")
    with pytest.raises(RecordingFormatError, match=r"rgb.txt: line 1: expected 'seconds file'"):
        open_source(tmp_path)
