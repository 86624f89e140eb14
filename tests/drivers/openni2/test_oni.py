"""Recordings by OpenNI2's recorder, replayed by OpenNI2's file driver; and files that are damaged."""

import logging
import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
from own_children import own_children
from recorded_oni import RecordedCamera, record_ten_frames
from virtual_camera import color_image, depth_image, frame_number

from nurbseg.common.errors import (
    BackendMissingError,
    EndOfRecordingError,
    FrameTimeoutError,
    RecordingFormatError,
)
from nurbseg.drivers.openni2.oni import player
from nurbseg.drivers.openni2.oni.file import correct_header, read_structure, write_end
from nurbseg.drivers.openni2.oni.playback import OniSource
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.registry import open_source


def record(path, options=None, frames=12, lossy=False):
    """Record from the only camera; return its calibration and the last frame's number."""
    with RecordedCamera(options=options) as source:
        source.record(path, lossy=lossy)
        for _ in range(frames):
            frame = source.read()
        source.finish()
        return source.calibration, frame_number(frame)


def replay(path, **options):
    with OniSource(path, SourceOptions(device=DeviceOptions(**options))) as source:
        return list(source)


@pytest.fixture
def recording(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "clip.oni"
    record(path)
    return path


def test_images_that_are_passed_on_the_way_to_a_frame_are_not_kept(recording, monkeypatch):
    with OniSource(recording) as source:
        kept, receive = [], source._player.receive

        def counted(timeout_s):
            kept.append(len(source._waiting))
            return receive(timeout_s)

        monkeypatch.setattr(source._player, "receive", counted)
        source.seek(8)
        assert source.read().index == 8
    assert len(kept) > 16
    assert max(kept) <= 3


def assert_exact(frames, registered=True, first=None):
    """Each frame is the camera's next one, in depth and color, from its first on."""
    for position, frame in enumerate(frames):
        number = frame_number(frame)
        assert frame.index == position
        assert number == (frame_number(frames[0]) if first is None else first) + position
        np.testing.assert_array_equal(frame.depth_mm, depth_image(number, registered=registered))
        np.testing.assert_array_equal(frame.color, color_image(number))


def test_a_recording_replays_exactly_and_whole(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "clip.oni"
    calibration, last = record(path, frames=30)
    with open_source(str(path)) as source:
        assert not source.live
        frames = list(source)
        assert source.half_pairs <= 1  # the recorder may stop between the two halves
        with pytest.raises(EndOfRecordingError):
            source.read()
    # From the camera's first frame to at least the last one that was seen live.
    assert_exact(frames, first=0)
    assert len(frames) > last
    assert frames[0].timestamp_ns == 0
    for camera in ("depth", "color"):
        replayed, live = getattr(frames[0].calibration, camera), getattr(calibration, camera)
        np.testing.assert_array_equal(replayed.matrix, live.matrix)
    assert frames[0].calibration.is_registered


@pytest.mark.parametrize("read", [0, 4, 100])
def test_a_recording_goes_to_any_frame_from_anywhere(recording, read):
    with open_source(str(recording)) as source:
        last = len(source) - 1
        for _, _ in zip(range(read), source, strict=False):
            pass
        for index in (3, 4, 2, 11, 10, 0, last):
            source.seek(index)
            frame = source.read(timeout_s=10.0)
            assert (frame.index, frame_number(frame)) == (index, index)
            np.testing.assert_array_equal(frame.depth_mm, depth_image(index))
            np.testing.assert_array_equal(frame.color, color_image(index))
        source.seek(last - 1)
        assert [frame.index for frame in source] == [last - 1, last]
        source.seek(1000)
        assert source.read(timeout_s=10.0).index == last
        assert len(own_children()) == 1
    assert not own_children()


def test_lossy_color_is_close_and_depth_exact(virtual_cameras, tmp_path, rng):
    # JPEG is made for pictures, so this camera shows a smooth one.
    row, col = np.mgrid[:480, :640]
    smooth = np.stack([row / 2, col / 3, (row + col) / 5], axis=-1).astype(np.uint8)
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "color_0000.raw").write_bytes(smooth.tobytes())
    virtual_cameras.add(frames=raw)
    path, exact = tmp_path / "clip.oni", tmp_path / "exact.oni"
    record(path, frames=5, lossy=True)
    record(exact, frames=5)
    for frame in replay(path):
        np.testing.assert_array_equal(frame.depth_mm, depth_image(frame_number(frame)))
        error = frame.color.astype(float) - smooth
        assert 10 * np.log10(255**2 / np.mean(error**2)) > 30
    assert path.stat().st_size < exact.stat().st_size / 2


def test_depth_and_color_are_each_mirrored_by_what_the_recording_says_of_them(recording, monkeypatch):
    plain = replay(recording)[0]
    description = OniSource._description

    def mirrored_color(source):
        played = description(source)
        return replace(played, color=replace(played.color, mirrored=True))

    monkeypatch.setattr(OniSource, "_description", mirrored_color)
    frame = replay(recording)[0]
    np.testing.assert_array_equal(frame.depth_mm, plain.depth_mm)
    np.testing.assert_array_equal(frame.color, plain.color[:, ::-1])


@pytest.mark.parametrize("mirror", [False, True])
def test_mirrored_recordings_replay_as_wanted(virtual_cameras, tmp_path, mirror):
    virtual_cameras.add()
    path = tmp_path / "clip.oni"
    record(path, DeviceOptions(mirror=mirror), frames=3)
    for wanted in (False, True):
        frame = replay(path, mirror=wanted)[0]
        np.testing.assert_array_equal(frame.depth_mm, depth_image(frame_number(frame), mirrored=wanted))
        np.testing.assert_array_equal(frame.color, color_image(frame_number(frame), mirrored=wanted))


def test_depth_in_tenths_of_a_millimetre_replays_in_millimeters(virtual_cameras, tmp_path):
    # The format holds 32767 different depths an image, fewer than the usual pattern has in tenths.
    depth = np.broadcast_to(np.arange(480, dtype=np.uint16)[:, None] * 2 + 4000, (480, 640))
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "depth_0000.raw").write_bytes(depth.tobytes())
    virtual_cameras.add(frames=raw)
    path = tmp_path / "clip.oni"
    record(path, DeviceOptions(depth_unit="100um"), frames=3)
    rounding_up = (np.arange(640) % 10 >= 5).astype(np.uint16)
    for frame in replay(path):
        np.testing.assert_array_equal(frame.depth_mm, depth + rounding_up)


@pytest.mark.parametrize("stored", ["1mm", "100um"])
def test_a_given_unit_of_depth_counts_before_that_of_the_recording(virtual_cameras, tmp_path, stored, caplog):
    depth = np.broadcast_to(np.arange(480, dtype=np.uint16)[:, None] * 2 + 1000, (480, 640))
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "depth_0000.raw").write_bytes(depth.tobytes())
    virtual_cameras.add(frames=raw)
    record(tmp_path / "clip.oni", DeviceOptions(depth_unit=stored), frames=3)
    # In the recording, one of the camera's millimeters is a unit, or ten and its last digit.
    units = depth if stored == "1mm" else depth.astype(int) * 10 + np.arange(640) % 10
    per_meter = 1000 if stored == "1mm" else 10_000
    for given, expected in ((per_meter, per_meter), (2 * per_meter, 2 * per_meter)):
        with OniSource(tmp_path / "clip.oni", SourceOptions(depth_scale=float(given))) as source:
            frame = source.read(5.0)
        assert np.abs(frame.depth_mm - units * (1000 / expected)).max() <= 0.5
    assert "--depth-scale" in source.metadata["depth_unit"]
    assert "OpenNI2's own" in caplog.text


def test_dropped_images_are_left_out_when_replayed(virtual_cameras, tmp_path):
    virtual_cameras.add(drop_color="4,7-8", drop_depth="10")
    path = tmp_path / "clip.oni"
    record(path, DeviceOptions(sync=False), frames=12)
    frames = replay(path)
    numbers = [frame_number(frame) for frame in frames]
    assert not {4, 7, 8, 10} & set(numbers)
    assert numbers == sorted(set(range(numbers[-1] + 1)) - {4, 7, 8, 10})
    for frame, number in zip(frames, numbers, strict=True):
        np.testing.assert_array_equal(frame.depth_mm, depth_image(number))
        np.testing.assert_array_equal(frame.color, color_image(number))


def test_other_modes_are_recorded_and_replayed(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "clip.oni"
    record(path, DeviceOptions(depth_mode="qvga", color_mode="qvga"), frames=20)
    for frame in replay(path):
        number = frame_number(frame, 60)
        np.testing.assert_array_equal(frame.depth_mm, depth_image(number, 320, 240))
        np.testing.assert_array_equal(frame.color, color_image(number, 320, 240))


def test_a_killed_recording_replays_to_its_last_frame(virtual_cameras, tmp_path, caplog):
    virtual_cameras.add()
    path, killed = tmp_path / "clip.oni", tmp_path / "killed.oni"
    killed.write_bytes(record_ten_frames(path))
    with caplog.at_level(logging.WARNING):
        frames = replay(killed)
    assert "is truncated" in caplog.text
    assert len(frames) >= 5
    assert_exact(frames, first=0)


def test_a_header_that_counts_too_few_streams_is_corrected(recording):
    """OpenNI2's recorder leaves such a header now and then, where it is killed."""
    with recording.open("r+b") as file:
        file.seek(20)
        assert file.read(4) == b"\x02\0\0\0"
        file.seek(20)
        file.write(b"\x01\0\0\0")
    with pytest.raises(
        RecordingFormatError, match=r"header: .* nurbseg-record repair .*clip\.oni writes one"
    ):
        replay(recording)
    with recording.open("r+b") as file:
        assert correct_header(file)
        assert not correct_header(file)
    assert_exact(replay(recording), first=0)


def test_a_recording_that_was_cut_short_can_be_given_its_end(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path, cut = tmp_path / "clip.oni", tmp_path / "cut.oni"
    # As a kill leaves it: in the middle of a record, without an end.
    cut.write_bytes(record_ten_frames(path)[:-1000])
    before = replay(cut)
    assert not read_structure(cut).complete
    with cut.open("r+b") as file:
        assert write_end(file)
        assert not write_end(file)
    assert read_structure(cut).complete
    assert_exact(replay(cut), first=0)
    assert len(replay(cut)) == len(before) > 3


@pytest.mark.parametrize("kept", [0.001, 0.3, 0.6, 0.95])
def test_part_of_a_finished_file_is_refused_by_name(recording, kept):
    end = recording.read_bytes().rindex(b"NIR\0\x0b\0\0\0")
    with recording.open("r+b") as file:
        file.truncate(int(end * kept))
    with pytest.raises(RecordingFormatError, match=r"clip\.oni: cut short: \d+ bytes.*copy the whole file"):
        OniSource(recording)


def test_a_frame_of_the_wrong_size_is_refused(recording):
    content = bytearray(recording.read_bytes())
    assert content[4096:].count(b"NIR\0\x0a\0\0\0") > 5
    # The first color image: type 10 of node 2; its payload's size is at offset 16.
    at = content.index(b"NIR\0\x0a\0\0\0\x02\0\0\0")
    content[at + 16 : at + 20] = (921599).to_bytes(4, "little")
    recording.write_bytes(content)
    with pytest.raises(RecordingFormatError, match=r"color frame 1: 921599 bytes, 921600 expected"):
        OniSource(recording)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "header: not an OpenNI recording"),
        (b"NI10", "header: not an OpenNI recording"),
        (b"RIFF" + bytes(100), "header: not an OpenNI recording"),
        (b"NI10" + bytes(20), "depth: the recording holds no frames before it breaks off"),
        (b"NI10" + bytes(4000), "depth: the recording holds no frames before it breaks off"),
    ],
)
def test_files_without_frames_are_refused(virtual_cameras, tmp_path, content, message):
    path = tmp_path / "clip.oni"
    path.write_bytes(content)
    with pytest.raises(RecordingFormatError, match=rf"clip\.oni: {message}"):
        OniSource(path)


@pytest.mark.parametrize("sign", [b"NIQ\0", b"NIS\0"])
def test_a_record_without_its_sign_ends_what_can_be_read(recording, sign):
    content = recording.read_bytes()
    recording.write_bytes(content.replace(b"NIR\0", sign, 1))
    with pytest.raises(RecordingFormatError, match="depth: the recording holds no frames before it breaks"):
        OniSource(recording)


def test_garbage_never_crashes_or_hangs(recording, rng, monkeypatch):
    """A byte here and there, a block, and the whole of the frames: an error of ours, or frames."""
    monkeypatch.setattr(player, "_HANG_LIMIT_S", 2.0)
    sound = recording.read_bytes()
    for trial in range(30):
        content = bytearray(sound)
        if trial < 15:  # in the descriptions, which the driver trusts most
            for _ in range(1 + trial // 3):
                content[rng.integers(24, 2100)] = rng.integers(256)
        elif trial < 25:
            begin = int(rng.integers(2100, len(content) - 5000))
            content[begin : begin + 4000] = rng.bytes(4000)
        else:
            content[2100:] = rng.bytes(len(content) - 2100)
        recording.write_bytes(content)
        begun = time.monotonic()
        try:
            with OniSource(recording) as source:
                for frame in source:
                    assert frame.depth_mm.shape == (480, 640)
        except (RecordingFormatError, FrameTimeoutError) as err:
            assert "clip.oni" in str(err)
        assert time.monotonic() - begun < 60


def test_a_player_that_crashes_is_a_damaged_file(recording):
    with OniSource(recording) as source:
        source.read()
        os.kill(own_children()[0].pid, signal.SIGSEGV)
        with pytest.raises(RecordingFormatError, match="stopped with code -11; the file is damaged"):
            while True:
                source.read()


def test_a_player_that_hangs_times_out_and_is_then_given_up(recording, monkeypatch):
    monkeypatch.setattr(player, "_HANG_LIMIT_S", 0.6)
    with OniSource(recording) as source:
        source.read()
        os.kill(own_children()[0].pid, signal.SIGSTOP)
        with pytest.raises(FrameTimeoutError):
            while True:  # some frames are in the pipe already
                source.read(timeout_s=0.3)
        with pytest.raises(RecordingFormatError, match="hangs on it"):
            for _ in range(5):
                try:
                    source.read(timeout_s=0.3)
                except FrameTimeoutError:
                    continue


def test_closing_leaves_no_process(recording):
    source = OniSource(recording)
    source.read()
    source.close()
    assert not own_children()


def test_a_slow_reader_loses_nothing(recording):
    with OniSource(recording) as source:
        frames = []
        for frame in source:
            frames.append(frame)
            time.sleep(0.02)
        assert len(frames) == len(source)
    assert_exact(frames, first=0)


def test_skipping_continues_at_the_right_frame(recording):
    with OniSource(recording) as source:
        source.read()
        assert source.skip(4) == 4
        frame = source.read()
        assert frame.index == 5
        np.testing.assert_array_equal(frame.depth_mm, depth_image(5))
        assert source.skip(1000) == len(source) - 6


def test_without_the_library_the_package_is_named(recording, monkeypatch, tmp_path):
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(BackendMissingError, match=r"no libOpenNI2\.so\.0 in this folder"):
        OniSource(recording)


def test_a_recording_is_taken_as_registered_unless_said_otherwise(recording, caplog):
    with caplog.at_level(logging.WARNING):
        assert replay(recording)[0].calibration.is_registered
    assert "does not say whether depth is registered to color; taken as registered" in caplog.text
    assert not replay(recording, registration="software")[0].calibration.is_registered


def test_given_intrinsics_count_before_the_recordings(recording):
    options = SourceOptions(intrinsics=(600.0, 601.0, 320.0, 240.0))
    with open_source(recording, options) as source:
        assert source.calibration.color.fy == source.read().calibration.depth.fy == 601.0
        assert int(source.metadata["dropped"]) == source.half_pairs
