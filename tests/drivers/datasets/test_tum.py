"""The TUM RGB-D layout: lists of images, their association in time, poses, and lists that are hostile."""

import os
from pathlib import Path

import numpy as np
import pytest
from bounded_child import read_bounded
from hypothesis import given
from hypothesis import strategies as st
from recorded_scene import scene, scenes, write_image, write_tum

from nurbseg.drivers import CalibrationError, RecordingFormatError, RGBDFrame, SourceOptions, open_source
from nurbseg.drivers.datasets.tum import associate

K = (52.5, 52.5, 31.5, 23.5)
GIVEN = SourceOptions(intrinsics=K)
FRAME = scene(0)


def read(folder: Path, options: SourceOptions | None = GIVEN) -> tuple[list[RGBDFrame], dict[str, str]]:
    with open_source(folder, options) as source:
        return list(source), dict(source.metadata)


def listed(folder: Path, stamps: list[str], depth_stamps: list[str] | None = None) -> Path:
    """Write a folder with images of these times."""
    for kind, image, times in (
        ("rgb", FRAME.color, stamps),
        ("depth", FRAME.depth_mm * 5, depth_stamps or stamps),
    ):
        for number in range(len(times)):
            write_image(folder / kind / f"{number}.png", image)
        lines = [f"{stamp} {kind}/{number}.png" for number, stamp in enumerate(times)]
        (folder / f"{kind}.txt").write_text("\n".join(lines))
    return folder


def test_images_whose_partner_is_missing_are_dropped_and_counted(tmp_path: Path) -> None:
    write_tum(tmp_path, scenes(6))
    for name, line in (("rgb.txt", 2), ("rgb.txt", 4), ("depth.txt", 6)):
        lines = (tmp_path / name).read_text().splitlines()
        lines[line] = ""
        (tmp_path / name).write_text("\n".join(lines))
    frames, metadata = read(tmp_path)
    assert (len(frames), metadata["dropped"]) == (3, "3")


times = st.lists(st.integers(0, 1000), max_size=25).map(sorted)


@given(times, times, st.integers(0, 60))
def test_pairs_are_near_used_once_and_none_nearer_is_left(first, second, limit):
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


def without_calibration(folder: Path) -> None:
    (folder / "camera.toml").unlink()


def without_depth(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        path.unlink()


def line(text: str):
    return lambda folder: (folder / "rgb.txt").write_text(f"# color\n{text}\n")


@pytest.mark.parametrize(
    ("spoil", "options", "error", "said"),
    [
        *(
            (line(text), None, RecordingFormatError, r"rgb\.txt: line 2: expected 'seconds file'")
            for text in ("notanumber rgb/a.png", "1.5", "nan rgb/a.png", "inf x.png")
        ),
        (without_calibration, None, CalibrationError, "--intrinsics"),
        (without_depth, None, RecordingFormatError, r"none of the 2 frames.*depth/.*cannot be read"),
        (
            lambda folder: None,
            SourceOptions(association_limit_s=0.001),
            RecordingFormatError,
            r"none of 2 color and 2 depth images are within 0\.001 s",
        ),
        (
            lambda folder: (folder / "rgb.txt").write_text("1 a\n" * 600_000),
            None,
            RecordingFormatError,
            "rgb.txt: expected 500000 lines at most, got 600000",
        ),
        (
            lambda folder: os.truncate(folder / "rgb.txt", 8 << 30),
            None,
            RecordingFormatError,
            "rgb.txt: the list has 8589934592 bytes; expected 16777216 at most",
        ),
    ],
)
def test_a_folder_that_cannot_be_replayed_says_why(tmp_path, spoil, options, error, said):
    spoil(write_tum(tmp_path, scenes(2)))
    with pytest.raises(error, match=said):
        open_source(tmp_path, options)


def test_poses_of_other_times_are_said(tmp_path: Path, caplog) -> None:
    listed(tmp_path, ["1.0", "1.1"])
    (tmp_path / "groundtruth.txt").write_text("1000000000 0 0 0 0 0 0 1\n1100000000 0 0 0 0 0 0 1\n")
    assert read(tmp_path)[0][0].world_from_camera is None
    assert "no pose is within 0.02 s of an image: are its times seconds?" in caplog.text


def test_depth_may_come_first_in_a_list_of_pairs_in_folders(tmp_path: Path) -> None:
    write_image(tmp_path / "depth_1" / "rgb" / "0.png", FRAME.color)
    write_image(tmp_path / "depth_1" / "depth" / "0.png", FRAME.depth_mm)
    (tmp_path / "associations.txt").write_text("1.5 depth_1/depth/0.png 1.6 depth_1/rgb/0.png")
    (frame,), _ = read(tmp_path, SourceOptions(intrinsics=K, depth_scale=1000))
    np.testing.assert_array_equal(frame.depth_mm, FRAME.depth_mm)
    assert frame.timestamp_ns == 1_500_000_000


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_lists_as_windows_and_spreadsheets_write_them_are_read(tmp_path: Path, encoding: str) -> None:
    listed(tmp_path, ["1.0", "1.1"])
    for name in ("rgb.txt", "depth.txt"):
        text = (tmp_path / name).read_text().replace(" ", ", ").replace("/", "\\").replace("\n", "\r\n")
        (tmp_path / name).write_bytes(text.encode(encoding))
    frames, metadata = read(tmp_path)
    assert (len(frames), metadata["dropped"]) == (2, "0")
    np.testing.assert_array_equal(frames[1].depth_mm, FRAME.depth_mm)


def test_images_of_one_time_are_said_to_be_left_out(tmp_path: Path, caplog) -> None:
    frames, metadata = read(listed(tmp_path, ["7", "7", "7", "8"]))
    assert (len(frames), metadata["dropped"]) == (2, "4")
    assert "depth.txt: 2 images have the time of another one, and are left out" in caplog.text


@pytest.mark.parametrize(("late_s", "expected"), [(0.01, 20), (0.025, 10)])
def test_lists_whose_images_are_too_far_apart_are_said(tmp_path, late_s, expected, caplog):
    times = [1 + number / 15 for number in range(20)]
    late = [time_s + (late_s if number % 2 else 0.01) for number, time_s in enumerate(times)]
    frames, _ = read(listed(tmp_path, [f"{t:.6f}" for t in times], [f"{t:.6f}" for t in late]))
    assert len(frames) == expected
    said = "only 10 of 20 depth images have color within 0.02 s (--set association_limit_s=S)"
    assert (said in caplog.text) is (expected == 10)


def test_lists_lead_nowhere_else(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "tum", scenes(7))
    outside = tmp_path / "outside.png"
    write_image(outside, FRAME.depth_mm)
    os.mkfifo(folder / "fifo.png")
    (folder / "zero.png").symlink_to("/dev/zero")
    (folder / "link.png").symlink_to(outside)
    lines = [line.split() for line in (folder / "depth.txt").read_text().splitlines()[1:]]
    names = [str(outside), "../outside.png", "fifo.png", "zero.png", "link.png", "depth/\0.png"]
    for line, name in zip(lines, names, strict=False):
        line[1] = name
    (folder / "depth.txt").write_text("".join(f"{stamp} {name}\n" for stamp, name in lines))
    reading = read_bounded(folder)
    out = "the image is outside the recording's folder"
    expected = [out, out, "not a regular file", out, out, r"'depth/\x00.png': not the name of an image"]
    assert reading.frames == 1
    for error, said in zip(reading.errors, expected, strict=True):
        assert said in error


BAD_STAMPS = ["-5.0", "1e999999999", "9" * 5000, "nan", "1e15", "0x5", "1_0e300000"]


@pytest.mark.parametrize("stamp", [*BAD_STAMPS, None])
def test_a_line_out_of_bounds_costs_its_frame(tmp_path: Path, stamp: str | None, caplog) -> None:
    path = write_tum(tmp_path, scenes(3)) / "depth.txt"
    lines = path.read_text().splitlines()
    own, name = lines[2].split()
    lines[2] = f"{stamp} {name}" if stamp else f"{own} {'x' * 5000}"
    path.write_text("\n".join(lines[1:]))
    frames, metadata = read(tmp_path)
    assert (len(frames), metadata["dropped"]) == (2, "2")
    assert "depth.txt: line 2: expected 'seconds file', got '" in caplog.text
    assert "1 lines are skipped" in caplog.text
    assert len(caplog.text) < 1000


def test_a_list_of_one_moment_over_and_over_takes_neither_time_nor_memory(tmp_path: Path) -> None:
    folder = write_tum(tmp_path, scenes(2))
    for name in ("rgb.txt", "depth.txt"):
        (stamp, image), last = (line.split() for line in (folder / name).read_text().splitlines()[1:])
        lines = [f"{stamp} {image}\n"] * 50_000 + [f"{stamp}{n:05} {image}\n" for n in range(50_000)]
        (folder / name).write_text("".join([*lines, " ".join(last)]))
    reading = read_bounded(folder, frames_most=3)
    assert reading.frames == 3
    assert reading.taken_bytes < 1 << 29
