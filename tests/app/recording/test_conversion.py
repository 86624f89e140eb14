"""nurbseg-record cut, convert and extract: what comes out is what can be replayed of what went in."""

import json
import re
import resource
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from database_bag import to_database
from recorded_scene import APART, scenes, write_mcap, write_pairs

from nurbseg.app.recording.record_command import main
from nurbseg.drivers.registry import open_source

PERIOD_S = 0.033333333


def replayed(path):
    with open_source(path) as source:
        return list(source)


@pytest.fixture
def frames():
    found = scenes(9, APART)
    pose = np.eye(4)
    pose[:3, 3] = [0.1, -0.25, 1.0 / 3.0]
    return [replace(each, world_from_camera=pose, gravity=[0, 0.6, 0.8]) for each in found]


@pytest.fixture
def recording(tmp_path, frames) -> Path:
    return write_mcap(tmp_path / "a.mcap", frames, "png")


@pytest.fixture
def bag(tmp_path, recording) -> Path:
    return to_database(recording, tmp_path / "a.db3")


def assert_same(one, other, *, gravity=True):
    for name in ("depth_mm", "color", "labels"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_allclose(one.world_from_camera, other.world_from_camera, atol=1e-12)
    if gravity:
        np.testing.assert_allclose(one.gravity, other.gravity, atol=1e-12)
    for name in ("depth", "color"):
        cameras = [getattr(each.calibration, name) for each in (one, other)]
        np.testing.assert_array_equal(cameras[0].matrix, cameras[1].matrix)
        np.testing.assert_array_equal(cameras[0].distortion, cameras[1].distortion)
    np.testing.assert_allclose(
        one.calibration.color_from_depth, other.calibration.color_from_depth, atol=1e-12
    )


def test_a_recording_is_written_again_with_all_that_it_holds(recording, frames, tmp_path, capsys):
    assert main(["convert", str(recording), str(tmp_path / "b.mcap"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["frames"], told["damaged"]) == (9, 0)
    assert told["seconds"] == pytest.approx(8 * PERIOD_S, abs=1e-3)
    for one, other in zip(frames, replayed(tmp_path / "b.mcap"), strict=True):
        assert one.timestamp_ns == other.timestamp_ns
        assert_same(one, other)
    assert main(["check", str(tmp_path / "b.mcap")]) == 0


@pytest.mark.parametrize(
    ("begin", "end", "numbers"), [("0.05", "0.19", range(2, 6)), ("0", "0.01", [0]), ("0.26", "inf", [8])]
)
def test_what_is_cut_is_from_one_moment_to_before_another(
    recording, frames, tmp_path, capsys, begin, end, numbers
):
    assert main(["cut", str(recording), str(tmp_path / "b.mcap"), "--from", begin, "--to", end]) == 0
    assert f"{len(numbers)} frames" in capsys.readouterr().out
    for number, frame in zip(numbers, replayed(tmp_path / "b.mcap"), strict=True):
        assert frame.timestamp_ns == frames[number].timestamp_ns
        assert_same(frame, frames[number])


def test_a_clock_that_was_set_back_costs_no_frame(tmp_path, frames, capsys):
    back = [replace(frame, timestamp_ns=frame.timestamp_ns - 3_000_000_000) for frame in frames[4:]]
    path = write_mcap(tmp_path / "back.mcap", [*frames[:4], *back], "png")
    assert main(["convert", str(path), str(tmp_path / "out.mcap")]) == 0
    assert [each.timestamp_ns for each in replayed(tmp_path / "out.mcap")] == [
        each.timestamp_ns for each in (*frames[:4], *back)
    ]
    # Three steps before, four after.
    assert "9 frames, 0.233 s" in capsys.readouterr().out
    assert main(["cut", str(path), str(tmp_path / "cut.mcap"), "--from", "0.11", "--to", "0.18"]) == 0
    assert len(replayed(tmp_path / "cut.mcap")) == 2


def test_images_are_extracted_that_can_be_replayed(recording, frames, tmp_path):
    folder = tmp_path / "deep" / "images"
    assert main(["extract", str(recording), str(folder)]) == 0
    assert len(list(folder.iterdir())) == 4 * 9 + 1
    for one, other in zip(frames, replayed(folder), strict=True):
        assert_same(one, other, gravity=False)


def test_extracted_depth_that_would_be_implausible_states_its_unit(tmp_path):
    far = scenes(1)[0]
    coarse = replace(far, depth_mm=far.depth_mm // 5 * 5)
    path = write_mcap(tmp_path / "a.mcap", [coarse])
    assert main(["extract", str(path), str(tmp_path / "images")]) == 0
    (frame,) = replayed(tmp_path / "images")
    np.testing.assert_array_equal(frame.depth_mm, coarse.depth_mm)


def test_a_bag_of_another_kind_becomes_an_mcap(bag, frames, tmp_path):
    assert main(["convert", str(bag), str(tmp_path / "b.mcap")]) == 0
    for one, other in zip(frames, replayed(tmp_path / "b.mcap"), strict=True):
        np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.labels, other.labels)


def test_images_become_an_mcap(tmp_path):
    folder = write_pairs(tmp_path / "pairs", scenes(3))
    assert main(["convert", str(folder), str(tmp_path / "b.mcap"), "--color", "raw"]) == 0
    for one, other in zip(replayed(folder), replayed(tmp_path / "b.mcap"), strict=True):
        np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
        np.testing.assert_array_equal(one.color, other.color)


def test_damaged_frames_are_left_out_and_counted(bag, frames, tmp_path, capsys):
    """Two depth images lose their pixels."""
    depth = "(SELECT id FROM topics WHERE name = '/camera/depth/image_raw')"
    with sqlite3.connect(bag) as base:
        base.execute(
            "UPDATE messages SET data = substr(data, 1, 60) WHERE id IN "
            f"(SELECT id FROM messages WHERE topic_id = {depth} ORDER BY id LIMIT 2 OFFSET 3)"
        )
    base.close()
    assert main(["convert", str(bag), str(tmp_path / "b.mcap"), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["frames"], told["damaged"]) == (7, 2)
    kept = [frame.timestamp_ns for frame in replayed(tmp_path / "b.mcap")]
    assert kept == [frame.timestamp_ns for n, frame in enumerate(frames) if n not in (3, 4)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["convert", "{bag}", "{tmp}/b.avi"], "expected a name that ends in .mcap"),
        (["convert", "{tmp}/none.db3", "{tmp}/b.mcap"], "no such file or folder"),
        (
            ["cut", "{bag}", "{tmp}/b.mcap", "--from", "5", "--to", "9"],
            r"no frame from 5 s to 9 s; the last is at 0",
        ),
        (["convert", "{tmp}/a.mcap", "{tmp}/a.mcap", "--force"], "is the recording itself"),
        (["convert", "{bag}", "{tmp}/a.mcap"], "already exists; .*or overwrite it with --force"),
        (["extract", "{bag}", "{tmp}"], "is not empty"),
        (["extract", "{bag}", "{tmp}/a.mcap"], "cannot be written"),
        (["convert", "{bag}", "{tmp}/b.mcap", "--depth-topic", "/no"], "no such topic"),
        (["convert", "{bag}", "{tmp}/b.mcap", "--depth-scale", "-1"], "depth_scale"),
    ],
)
def test_what_cannot_be_done_is_said_and_leaves_nothing(bag, tmp_path, capsys, words, message):
    before = sorted(tmp_path.iterdir())
    given = [word.format(bag=bag, tmp=tmp_path) for word in words]
    assert main(given) == 2
    error = capsys.readouterr().err
    assert error.startswith("nurbseg-record: error: ")
    assert re.search(message, error), error
    assert sorted(tmp_path.iterdir()) == before


def test_with_force_what_exists_is_replaced(bag, tmp_path):
    (tmp_path / "b.mcap").write_text("other")
    assert main(["convert", str(bag), str(tmp_path / "b.mcap"), "--force"]) == 0
    assert len(replayed(tmp_path / "b.mcap")) == 9


def test_with_force_what_exists_stays_if_there_is_nothing_to_write(bag, tmp_path):
    (tmp_path / "b.mcap").write_text("other")
    assert main(["cut", str(bag), str(tmp_path / "b.mcap"), "--from", "50", "--to", "60", "--force"]) == 2
    assert (tmp_path / "b.mcap").read_text() == "other"


@pytest.mark.parametrize("words", [[], ["--from", "x", "--to", "1"], ["--from", "-1", "--to", "1"]])
def test_moments_must_be_given_as_seconds(words, capsys):
    with pytest.raises(SystemExit) as raised:
        main(["cut", "a", "b.mcap", *words])
    assert raised.value.code == 2
    assert "--from" in capsys.readouterr().err


def test_a_disk_that_is_full_is_another_exit_code(bag, tmp_path):
    command = [str(Path(sys.executable).with_name("nurbseg-record")), "convert", str(bag)]
    done = subprocess.run(
        [*command, str(tmp_path / "b.mcap")],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert "cannot be written: File too large" in done.stderr
    assert not (tmp_path / "b.mcap").exists()
