"""Recording while a run goes on: what is kept, what is lost, and how it ends."""

import errno
import logging
import os
import resource
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scripted_source import ScriptedSource, small_frame

from nurbseg.app.command.arguments import parse_arguments
from nurbseg.app.live.capture import CaptureThread
from nurbseg.app.recording import recording as recordings
from nurbseg.app.recording.recorder import RecordError, log_recorded, open_recording
from nurbseg.app.recording.recording import Recording, free_space
from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.drivers.registry import open_source

LARGE = 10**12


@pytest.fixture(autouse=True)
def much_room(monkeypatch):
    monkeypatch.setattr(recordings, "free_space", lambda _: LARGE)


class Pen:
    """Writes nothing; waits until it is allowed to, and fails when it is told to."""

    def __init__(self, path, *, waits=False, fails_at=None, error=None):
        self.written = []
        self.closed = threading.Event()
        self.allowed = threading.Event()
        self.began = threading.Event()
        self._fails_at = fails_at
        self._error = error or OSError(errno.ENOSPC, "No space left on device")
        if not waits:
            self.allowed.set()

    def write(self, frame, camera=0):
        self.began.set()
        assert self.allowed.wait(30)
        if len(self.written) == self._fails_at:
            raise self._error
        self.written.append(frame.index)

    def close(self):
        self.closed.set()


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "run.mcap"
    path.touch()
    return path


def recorded(path):
    with open_source(path) as source:
        return list(source)


def test_every_frame_is_in_the_file_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "_QUEUE_BYTES_MAX", 1)
    path = tmp_path / "new folder" / "run.mcap"
    config = RecordConfig(file=str(path), color="raw")
    frames = [small_frame(index) for index in range(20)]
    source = ScriptedSource([])
    source.metadata["serial"] = "S1"
    with open_recording(config, source, lossless=True) as recording:
        for frame in frames:
            recording.put(frame)
    assert (recording.frames, recording.lost, recording.failure) == (20, 0, "")
    for before, after in zip(frames, recorded(path), strict=True):
        assert after.timestamp_ns == before.timestamp_ns
        assert np.array_equal(after.depth_mm, before.depth_mm)
        assert np.array_equal(after.color, before.color)
    with open_source(path) as source:
        assert source.metadata["serial"] == "S1"


def test_putting_a_frame_does_not_wait_for_the_file(path, monkeypatch):
    monkeypatch.setattr(recordings, "_QUEUE_BYTES_MAX", 5 * small_frame(0).depth_mm.nbytes * 5 // 2)
    pen = Pen(path, waits=True)
    recording = Recording(path, lambda _: pen, RecordConfig())
    recording.put(small_frame(0))
    assert pen.began.wait(10)
    assert not recording.behind
    for index in range(1, 9):
        recording.put(small_frame(index))
    # One is being written, five fit into the queue, three are too many.
    assert recording.behind
    assert recording.lost == 3
    pen.allowed.set()
    recording.close()
    assert pen.written == [0, 1, 2, 3, 4, 5]
    assert (recording.frames, recording.lost) == (6, 3)


def test_a_lossless_recording_makes_its_source_wait_and_loses_nothing(path, monkeypatch):
    monkeypatch.setattr(recordings, "_QUEUE_BYTES_MAX", 1)
    pen = Pen(path, waits=True)
    recording = Recording(path, lambda _: pen, RecordConfig(), lossless=True)

    def put_all():
        for index in range(30):
            recording.put(small_frame(index))

    putting = threading.Thread(target=put_all)
    putting.start()
    assert pen.began.wait(10)
    assert not recording.behind
    pen.allowed.set()
    putting.join(10)
    recording.close()
    assert pen.written == list(range(30))
    assert recording.lost == 0


def test_while_the_recording_is_behind_frames_are_kept_from_being_segmented(path, monkeypatch):
    monkeypatch.setattr(recordings, "_QUEUE_BYTES_MAX", 20 * small_frame(0).depth_mm.nbytes * 5 // 2)
    pen = Pen(path, waits=True)
    source = ScriptedSource([small_frame(index) for index in range(15)])
    capture = CaptureThread(source, lossless=True)
    with Recording(path, lambda _: pen, RecordConfig()) as recording:
        capture.record(recording)
        with capture:
            indexes = []
            while (captured := capture.frames.take(10.0)) is not None:
                indexes.append(captured.frame.index)
            assert capture.withheld == 15 - len(indexes)
            # From the ninth waiting frame on; the first may be out of the queue already or not.
            assert len(indexes) in (8, 9)
        pen.allowed.set()
    assert pen.written == list(range(15))
    assert recording.lost == 0


def test_the_length_of_a_recording_is_without_jumps_of_the_clock(path, caplog):
    # A second before the clock is set back, two after it, and half a second after it was set forward.
    stamps_s = [100.0, 100.5, 101.0, 7.0, 9.0, 5000.0, 5000.5]
    with Recording(path, Pen, RecordConfig()) as recording:
        for index, stamp_s in enumerate(stamps_s):
            recording.put(replace(small_frame(index), timestamp_ns=round(1e9 * stamp_s)))
    with caplog.at_level(logging.INFO):
        log_recorded(recording)
    assert "recorded 7 frames, 3.5 s, " in caplog.text


def test_the_delay_goes_by_the_frames_own_clock(path):
    pen = Pen(path)
    config = RecordConfig(file="x.mcap", delay_s=0.5)
    with Recording(path, lambda _: pen, config) as recording:
        for index in range(30):
            recording.put(small_frame(index))
    assert pen.written == list(range(15, 30))
    assert recording.lost == 0


@pytest.mark.parametrize(("delay_s", "back", "first"), [(0.0, 5, 0), (0.5, 5, 20), (0.5, 25, 15)])
def test_a_clock_that_is_set_back_costs_no_frame(path, delay_s: float, back: int, first: int):
    pen = Pen(path)
    with Recording(path, lambda _: pen, RecordConfig(file="x.mcap", delay_s=delay_s)) as recording:
        for index in range(40):
            # By an hour.
            recording.put(small_frame(index, (7200 if index < back else 3600) + index / 30))
    assert pen.written == list(range(first, 40))
    assert recording.lost == 0


def test_recording_stops_before_the_disk_is_full_and_the_file_can_be_replayed(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    left = iter([LARGE] * 6)
    config = RecordConfig(file=str(path), space_min_mb=100)
    monkeypatch.setattr(recordings, "free_space", lambda _: next(left, 99_000_000))
    recording = open_recording(config, ScriptedSource([]))
    with recording:
        for index in range(12):
            recording.put(small_frame(index))
    # One of the six answers was given when the recording began.
    assert recording.frames == 5
    assert recording.frames + recording.lost == 12
    assert recording.ended
    with pytest.raises(RecordError, match=r"run\.mcap: recording stopped: only 99 MB .* 5 previous frames"):
        log_recorded(recording)
    assert len(recorded(path)) == 5


def test_a_recording_knows_its_size_and_how_much_it_may_still_become(path, monkeypatch):
    monkeypatch.setattr(recordings, "free_space", lambda _: 350_000_000)
    path.write_bytes(bytes(3_000_000))
    config = RecordConfig(space_min_mb=100)
    with Recording(path, Pen, config) as recording:
        recording.put(small_frame(0))
    assert (recording.size_mb, recording.written_mb, recording.room_mb) == (3.0, 3.0, 250.0)
    assert recording.figures()["megabytes"] == 3.0


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (ValueError("depth: expected 640x480"), "expected 640x480"),
        (RuntimeError("the encoder broke"), "the encoder broke"),
    ],
)
def test_a_write_that_fails_ends_the_recording_but_not_the_run(path, error, words):
    pen = Pen(path, fails_at=3, error=error)
    recording = Recording(path, lambda _: pen, RecordConfig())
    for index in range(4):
        recording.put(small_frame(index))
    assert pen.closed.wait(10)
    recording.put(small_frame(4))
    recording.close()
    assert words in recording.failure
    assert (recording.frames, recording.lost) == (3, 2)


def test_too_little_space_to_begin_with_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "free_space", lambda _: 400_000_000)
    config = RecordConfig(file=str(tmp_path / "run.mcap"), space_min_mb=500)
    with pytest.raises(RecordError, match=r"only 400 MB .* left, and recording stops at 500 MB"):
        open_recording(config, ScriptedSource([]))
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_never_replaced(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(RecordError, match="already exists"):
        open_recording(RecordConfig(file=str(path)), ScriptedSource([]))
    assert path.read_bytes() == b"precious"


def test_a_folder_that_cannot_be_made_is_an_error_that_names_the_file(tmp_path):
    (tmp_path / "folder").touch()
    with pytest.raises(RecordError, match=r"run\.mcap: cannot be written"):
        open_recording(RecordConfig(file=str(tmp_path / "folder/run.mcap")), ScriptedSource([]))


def test_a_recording_and_its_parts_are_for_this_user_alone(tmp_path):
    path = tmp_path / "run.mcap"
    before = os.umask(0)
    try:
        with open_recording(RecordConfig(file=str(path), split_s=1.0), ScriptedSource([])) as recording:
            for index in range(40):
                recording.put(small_frame(index))
    finally:
        os.umask(before)
    assert len(recording.files) == 2
    assert [file.stat().st_mode & 0o777 for file in recording.files] == [0o600, 0o600]


def test_a_recording_continues_in_another_file_after_some_time(tmp_path):
    path, taken = tmp_path / "run.mcap", tmp_path / "run-2.mcap"
    taken.write_bytes(b"precious")
    config = RecordConfig(file=str(path), split_s=1.0, color="raw")
    with open_recording(config, ScriptedSource([])) as recording:
        for index in range(45, 120):
            recording.put(small_frame(index))
    parts = [tmp_path / name for name in ("run.mcap", "run-3.mcap", "run-4.mcap")]
    assert recording.files == tuple(parts)
    assert recording.figures()["files"] == [str(part) for part in parts]
    assert taken.read_bytes() == b"precious"
    # Thirty frames of 30 Hz are a second.
    numbers = [[round(frame.timestamp_ns * 30e-9) for frame in recorded(part)] for part in parts]
    assert numbers == [list(range(45, 75)), list(range(75, 105)), list(range(105, 120))]


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_the_reported_frames_are_those_in_the_file_when_the_disk_is_full(tmp_path, share, caplog):
    whole, path = tmp_path / "whole.mcap", tmp_path / "run.mcap"
    frames = [small_frame(index) for index in range(30)]
    with open_recording(RecordConfig(file=str(whole)), ScriptedSource([])) as recording:
        for frame in frames:
            recording.put(frame)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    recording = open_recording(RecordConfig(file=str(path)), ScriptedSource([]))
    # The system refuses to let a file grow past this, as a full disk would.
    resource.setrlimit(resource.RLIMIT_FSIZE, (round(share * whole.stat().st_size), hard))
    try:
        for frame in frames:
            recording.put(frame)
        recording.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    there = len(recorded(path))
    assert 0 < there < 30
    assert (recording.frames, recording.lost) == (there, 30 - there)
    assert (recording.figures()["frames"], recording.figures()["lost"]) == (there, 30 - there)
    assert f"{there} frames are in the file" in caplog.text


def test_a_recording_that_is_deleted_is_said_once_and_ends(tmp_path, caplog):
    path = tmp_path / "run.mcap"
    with open_recording(RecordConfig(file=str(path), split_s=1.0), ScriptedSource([])) as recording:
        for index in (0, 30):
            recording.put(small_frame(index))
        while recording.frames < 2:
            time.sleep(0.001)
        recording.files[-1].unlink()
        for index in range(31, 35):
            recording.put(small_frame(index))
    assert recording.ended
    assert caplog.text.count("was deleted or moved") == 1
    with pytest.raises(RecordError, match=r"run-2\.mcap was deleted or moved"):
        log_recorded(recording)


def test_a_recording_without_frames_leaves_no_file(tmp_path):
    path = tmp_path / "run.mcap"
    with open_recording(RecordConfig(file=str(path)), ScriptedSource([])) as recording:
        assert path.exists()
    assert not path.exists()
    assert recording.figures()["frames"] == 0


def test_closing_gives_up_on_what_cannot_be_written_in_time_and_counts_it(path):
    pen = Pen(path, waits=True)
    recording = Recording(path, lambda _: pen, RecordConfig())
    for index in range(5):
        recording.put(small_frame(index))
    assert pen.began.wait(10)
    closing = threading.Thread(target=recording.close, args=(0.05,))
    closing.start()
    closing.join(0.5)
    pen.allowed.set()
    closing.join(10)
    assert pen.written == [0]
    assert (recording.frames, recording.lost) == (1, 4)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"file": "run.avi"}, r"expected a name that ends in \.mcap, got 'run\.avi'$"),
        (
            {"file": "x.ONI"},
            r"ends in \.mcap, got 'x\.ONI' \(\.oni recordings are replayed, but no",
        ),
        ({"only": True}, "expected a file"),
        ({"file": "x.mcap", "delay_s": -1.0}, "delay_s: expected at least"),
        ({"split_s": 60.0}, "expected a file"),
        ({"file": "x.mcap", "color": "gif"}, "color: expected one of"),
    ],
)
def test_wrong_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        RecordConfig(**settings)


@pytest.mark.parametrize("words", [["--export", "out"], ["--save", "out.rrd"]])
def test_recording_only_and_results_exclude_each_other(words, capsys):
    with pytest.raises(SystemExit) as ended:
        parse_arguments(["--record", "x.mcap", "--record-only", *words])
    assert ended.value.code == 2
    assert "nothing is segmented" in capsys.readouterr().err


def test_the_flags_of_a_recording_are_a_section_of_the_configuration():
    words = [
        "--record",
        "x.mcap",
        "--record-delay",
        "2.5",
        "--record-color",
        "png",
        "--set",
        "space_min_mb=50",
    ]
    config = parse_arguments(words).config.record
    assert config == RecordConfig(file="x.mcap", delay_s=2.5, color="png", space_min_mb=50)


def test_the_space_is_that_of_the_files_own_disk(tmp_path):
    assert free_space(tmp_path / "x.mcap") > 0
    assert isinstance(free_space(Path("x.mcap")), int)
