"""nurbseg-record: recordings that are whole, cut short or damaged, as it tells and repairs them."""

import json
import os
import resource
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded_oni import record_ten_frames
from recorded_scene import scenes, write_mcap
from robot_bag import Bag
from virtual_camera import openni2_redist, virtual_cameras

from nurbseg.app.recording.record_command import main
from nurbseg.app.view.viewer import viewer_executable
from nurbseg.drivers.registry import open_source

__all__ = ["openni2_redist", "virtual_cameras"]


def found(capsys, *words):
    """The command's exit code, and what it found of the first file."""
    code = main([*words, "--json"])
    return code, json.loads(capsys.readouterr().out)[0]


def replayed(path):
    with open_source(path) as source:
        return list(source)


@pytest.fixture
def whole(tmp_path) -> Path:
    return write_mcap(tmp_path / "a.mcap", scenes(12))


@pytest.fixture
def cut(whole) -> Path:
    """As a kill leaves it: in the middle of its ninth frame."""
    path = whole.with_name("cut.mcap")
    content = whole.read_bytes()
    path.write_bytes(content[: len(content) * 2 // 3])
    return path


def test_a_whole_recording_is_said_to_be(whole, capsys):
    code, told = found(capsys, "check", str(whole))
    assert code == 0
    assert (told["frames"], told["end_written"]) == (12, True)
    assert (told["problems"], told["gaps"]) == ([], [])
    assert told["last_ns"] == scenes(12)[-1].timestamp_ns


def test_gaps_are_reported_by_the_frame_before_them(tmp_path, capsys):
    frames = scenes(12)
    path = write_mcap(tmp_path / "a.mcap", frames[:4] + frames[7:])
    code, told = found(capsys, "check", str(path))
    assert code == 0
    assert told["gaps"] == [[3, 0.133]]


def test_a_recording_that_was_cut_short_is_repaired_with_an_index(cut, whole, capsys):
    before = cut.read_bytes()
    code, told = found(capsys, "check", str(cut))
    assert code == 1
    assert not told["end_written"]
    frames = replayed(cut)
    assert told["frames"] == len(frames) > 4

    code, told = found(capsys, "repair", str(cut))
    repaired = cut.with_name("cut-repaired.mcap")
    assert (code, told["frames"]) == (0, len(frames))
    # In Rerun, too.
    rerun = [str(viewer_executable()), "mcap", "check", str(repaired)]
    assert subprocess.run(rerun, capture_output=True, timeout=120).returncode == 0
    assert cut.read_bytes() == before
    assert repaired.stat().st_mode & 0o777 == 0o600
    for one, other in zip(frames, replayed(repaired), strict=True):
        assert one.timestamp_ns == other.timestamp_ns
        np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
        np.testing.assert_array_equal(one.color, other.color)
    with repaired.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        depth = {m.publish_time for _, _, m in reader.iter_messages(topics=["/camera/depth/image_raw"])}
        assert {frame.timestamp_ns for frame in frames} <= depth
        assert reader.get_header().profile == "ros2"
        assert {record.name for record in reader.iter_metadata()} == {"nurbseg", "device"}


@pytest.mark.parametrize("size", [8, 100])
def test_a_recording_that_was_cut_before_its_first_message_is_not_repaired(whole, size, capsys):
    content = whole.read_bytes()[:size]
    whole.write_bytes(content)
    for words in ((), ("--out", str(whole), "--force")):
        assert main(["repair", str(whole), *words]) == 2
        assert f"error: {whole}: the recording has no message" in capsys.readouterr().err
    assert [(path, path.read_bytes()) for path in whole.parent.iterdir()] == [(whole, content)]


def test_a_damaged_chunk_costs_its_frames_and_no_more(whole, capsys):
    content = bytearray(whole.read_bytes())
    content[len(content) // 2 :][:50] = b""
    content[len(content) // 2 : len(content) // 2 + 50] = bytes(50)
    whole.write_bytes(content)
    code, told = found(capsys, "check", str(whole))
    assert code == 1
    assert told["problems"][0].startswith("1 damaged: ")
    code, told = found(capsys, "repair", str(whole))
    assert (code, told["frames"]) == (0, 11)
    assert told["remarks"] == [f"damaged parts of {whole} that were left out: 1"]


def test_no_file_is_replaced_unless_requested(cut, capsys):
    out = cut.with_name("cut-repaired.mcap")
    out.write_bytes(b"precious")
    assert main(["repair", str(cut)]) == 2
    said = "already exists; name another file or remove it, or overwrite it with --force"
    assert said in capsys.readouterr().err
    assert out.read_bytes() == b"precious"
    assert main(["repair", str(cut), "--force"]) == 0
    assert main(["check", str(out)]) == 0
    assert main(["repair", str(cut), "--out", str(cut), "--force"]) == 0
    assert main(["check", str(cut)]) == 0
    assert not list(cut.parent.glob(".*"))


def test_a_full_disk_ends_a_repair_with_1_and_loses_nothing(cut, capsys):
    before = {path: path.read_bytes() for path in cut.parent.iterdir()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The system refuses to let a file grow past this, as a full disk would.
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        code = main(["repair", str(cut), "--out", str(cut), "--force"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 1
    assert f"error: {cut}: cannot be written: " in capsys.readouterr().err
    assert {path: path.read_bytes() for path in cut.parent.iterdir()} == before


@pytest.mark.parametrize("command", ["check", "repair"])
def test_a_pointer_in_place_of_a_file_is_named(command, tmp_path, capsys):
    pointer = tmp_path / "a.mcap"
    pointer.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n")
    assert main([command, str(pointer)]) == 2
    assert "a pointer of Git LFS" in capsys.readouterr().err


def test_a_split_bag_is_checked_as_a_whole(whole, cut, tmp_path, capsys):
    bag = tmp_path / "bag"
    bag.mkdir()
    for number in range(2):
        (bag / f"bag_{number}.mcap").write_bytes(whole.read_bytes())
    assert main(["check", str(bag)]) == 0
    told = capsys.readouterr().out
    assert "bag: whole, 24 frames" in told
    (bag / "bag_1.mcap").write_bytes(cut.read_bytes())
    assert main(["check", str(bag)]) == 1
    told = capsys.readouterr().out
    assert "it was not closed properly" in told and "to repair" not in told


@pytest.mark.parametrize("command", ["info", "check"])
def test_names_that_a_recording_gives_are_short_and_printable(command, tmp_path, capsys):
    path = tmp_path / "a.mcap"
    name = "\x1b[2J\x07" + "x" * 40_000
    bag = Bag(path)
    for index in range(30):
        bag.image(f"/{name}{index}", 10**9, name, np.zeros((24, 32, 3), np.uint8), "rgb8")
    bag.close()
    main([command, str(path)])
    output = capsys.readouterr()
    said = output.out + output.err
    assert "and 10 more" in said
    assert "x" * 20 in said
    assert "x" * 80 not in said
    assert said.replace("\n", "").isprintable()


def test_the_worst_of_several_files_counts_and_what_is_no_recording_is_named(whole, cut, tmp_path, capsys):
    other = tmp_path / "notes.txt"
    other.write_text("notes")
    assert main(["check", str(whole), str(cut)]) == 1
    assert "to repair it: nurbseg-record repair" in capsys.readouterr().out
    assert main(["check", str(other), str(whole)]) == 2
    told = capsys.readouterr()
    assert "notes.txt: not a recording of a known format" in told.err
    assert "a.mcap: whole, 12 frames" in told.out
    assert main(["check", str(tmp_path / "absent.mcap")]) == 2
    (tmp_path / "images").mkdir()
    assert main(["check", str(tmp_path / "images")]) == 2
    assert "images: the folder is empty" in capsys.readouterr().err


def test_a_pipe_is_refused_without_waiting_for_it(tmp_path, capsys):
    os.mkfifo(tmp_path / "a.mcap")
    assert main(["check", str(tmp_path / "a.mcap")]) == 2
    assert "not a regular file" in capsys.readouterr().err


def test_an_oni_file_that_openni2_refuses_is_not_repaired(virtual_cameras, tmp_path, capsys):
    virtual_cameras.add()
    path, killed = tmp_path / "a.oni", tmp_path / "killed.oni"
    content = bytearray(record_ten_frames(path))
    # OpenNI2's recorder may leave such a header: it counts one stream of two.
    struct.pack_into("<I", content, 20, 1)
    killed.write_bytes(content[:-1000])
    code, told = found(capsys, "check", str(path))
    # The recorder may stop between the two images of a frame.
    one_image = "images without a partner, which are in no frame: 1"
    remarks = [remark for remark in told["remarks"] if remark != one_image]
    assert (code, told["end_written"], remarks) == (0, True, [])
    for command, said in (
        ("check", "killed.oni: header: counts one stream too few"),
        ("repair", "killed.oni: magic bytes: expected an MCAP file"),
    ):
        assert main([command, str(killed)]) == 2
        assert said in capsys.readouterr().err
