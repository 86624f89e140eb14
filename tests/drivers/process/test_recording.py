"""Recording while a run goes on: what is kept, what is lost, and how it ends."""

import errno
import os
import re
import resource
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scripted_source import CALIBRATION, small_frame

from nurbseg.common.errors import DriverError
from nurbseg.drivers.process import recording as recordings
from nurbseg.drivers.process.messages import RecordOptions
from nurbseg.drivers.process.recording import Recording
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
    return tmp_path / "run.mcap"


def begun(path, pen=None, *, lossless=False, source=None, **settings):
    """A recording, written by a pen if there is one."""
    options = RecordOptions(path, **settings)
    with pytest.MonkeyPatch.context() as patched:
        if pen is not None:
            patched.setattr(recordings, "RecordingWriter", lambda path, *_, **__: path.touch() or pen)
        return Recording(
            options, source or SimpleNamespace(calibration=CALIBRATION, metadata={}), lossless=lossless
        )


def put(recording, *frames):
    for frame in frames:
        while not recording.put(frame, 1.0):
            pass


def recorded(path):
    with open_source(path) as source:
        return list(source)


def test_every_frame_is_in_the_file_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "_QUEUE_BYTES_MAX", 1)
    path = tmp_path / "new folder" / "run.mcap"
    frames = [small_frame(index) for index in range(20)]
    source = SimpleNamespace(calibration=CALIBRATION, metadata={"serial": "S1"})
    with begun(path, source=source, lossless=True, color="raw") as recording:
        put(recording, *frames)
    state = recording.state()
    assert (state.frames, state.lost, state.failure, state.ended) == (20, 0, "", True)
    for before, after in zip(frames, recorded(path), strict=True):
        assert after.timestamp_ns == before.timestamp_ns
        assert np.array_equal(after.depth_mm, before.depth_mm)
        assert np.array_equal(after.color, before.color)
    with open_source(path) as source:
        assert source.metadata["serial"] == "S1"


def test_putting_a_frame_does_not_wait_for_the_file(path, monkeypatch):
    monkeypatch.setattr(recordings, "_QUEUE_BYTES_MAX", 5 * small_frame(0).depth_mm.nbytes * 5 // 2)
    pen = Pen(path, waits=True)
    recording = begun(path, pen)
    put(recording, small_frame(0))
    assert pen.began.wait(10)
    for index in range(1, 9):
        assert recording.put(small_frame(index), 0.0)
    # One is being written, five fit into the queue, three are too many.
    assert recording.state().lost == 3
    pen.allowed.set()
    recording.close()
    assert pen.written == [0, 1, 2, 3, 4, 5]
    assert (recording.state().frames, recording.state().lost) == (6, 3)


def test_a_lossless_recording_makes_its_source_wait_and_loses_nothing(path, monkeypatch):
    monkeypatch.setattr(recordings, "_QUEUE_BYTES_MAX", 1)
    pen = Pen(path, waits=True)
    recording = begun(path, pen, lossless=True)
    put(recording, small_frame(0))
    assert pen.began.wait(10)
    put(recording, small_frame(1))
    assert not recording.put(small_frame(2), 0.05)
    pen.allowed.set()
    put(recording, *(small_frame(index) for index in range(2, 30)))
    recording.close()
    assert pen.written == list(range(30))
    assert recording.state().lost == 0


def test_the_length_of_a_recording_is_without_jumps_of_the_clock(path):
    # A second before the clock is set back, two after it, and half a second after it was set forward.
    stamps_s = [100.0, 100.5, 101.0, 7.0, 9.0, 5000.0, 5000.5]
    with begun(path, Pen(path)) as recording:
        for index, stamp_s in enumerate(stamps_s):
            put(recording, replace(small_frame(index), timestamp_ns=round(1e9 * stamp_s)))
    assert (recording.state().frames, recording.state().seconds) == (7, 3.5)


def test_the_delay_goes_by_the_frames_own_clock(path):
    pen = Pen(path)
    with begun(path, pen, delay_s=0.5) as recording:
        put(recording, *(small_frame(index) for index in range(30)))
    assert pen.written == list(range(15, 30))
    assert recording.state().lost == 0


@pytest.mark.parametrize(("delay_s", "back", "first"), [(0.0, 5, 0), (0.5, 5, 20), (0.5, 25, 15)])
def test_a_clock_that_is_set_back_costs_no_frame(path, delay_s: float, back: int, first: int):
    pen = Pen(path)
    with begun(path, pen, delay_s=delay_s) as recording:
        for index in range(40):
            # By an hour.
            put(recording, small_frame(index, (7200 if index < back else 3600) + index / 30))
    assert pen.written == list(range(first, 40))
    assert recording.state().lost == 0


def test_recording_stops_before_the_disk_is_full_and_the_file_can_be_replayed(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    left = iter([LARGE] * 6)
    monkeypatch.setattr(recordings, "free_space", lambda _: next(left, 99_000_000))
    with begun(path, space_min_mb=100) as recording:
        put(recording, *(small_frame(index) for index in range(12)))
    # One of the six answers was given when the recording began.
    state = recording.state()
    assert (state.frames, state.lost, state.ended) == (5, 7, True)
    assert re.search(r"run\.mcap: recording stopped: only 99 MB", state.failure)
    assert len(recorded(path)) == 5


def test_a_recording_knows_its_size_and_how_much_it_may_still_become(path, monkeypatch):
    monkeypatch.setattr(recordings, "free_space", lambda _: 350_000_000)
    with begun(path, Pen(path), space_min_mb=100) as recording:
        path.write_bytes(bytes(3_000_000))
        put(recording, small_frame(0))
    assert (recording.state().written_mb, recording.state().room_mb) == (3.0, 250.0)


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
    recording = begun(path, pen)
    put(recording, *(small_frame(index) for index in range(4)))
    assert pen.closed.wait(10)
    put(recording, small_frame(4))
    recording.close()
    state = recording.state()
    assert words in state.failure
    assert (state.frames, state.lost) == (3, 2)


def test_too_little_space_to_begin_with_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "free_space", lambda _: 400_000_000)
    with pytest.raises(DriverError, match=r"only 400 MB .* left, and recording stops at 500 MB"):
        begun(tmp_path / "run.mcap", space_min_mb=500)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_never_replaced(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError, match="already exists"):
        begun(path)
    assert path.read_bytes() == b"precious"


def test_a_recording_and_its_parts_are_for_this_user_alone(tmp_path):
    path = tmp_path / "run.mcap"
    before = os.umask(0)
    try:
        with begun(path, split_s=1.0) as recording:
            put(recording, *(small_frame(index) for index in range(40)))
    finally:
        os.umask(before)
    assert len(recording.state().files) == 2
    assert [file.stat().st_mode & 0o777 for file in recording.state().files] == [0o600, 0o600]


def test_a_recording_continues_in_another_file_after_some_time(tmp_path):
    path, taken = tmp_path / "run.mcap", tmp_path / "run-2.mcap"
    taken.write_bytes(b"precious")
    with begun(path, split_s=1.0, color="raw") as recording:
        put(recording, *(small_frame(index) for index in range(45, 120)))
    parts = [tmp_path / name for name in ("run.mcap", "run-3.mcap", "run-4.mcap")]
    assert recording.state().files == tuple(parts)
    assert taken.read_bytes() == b"precious"
    # Thirty frames of 30 Hz are a second.
    numbers = [[round(frame.timestamp_ns * 30e-9) for frame in recorded(part)] for part in parts]
    assert numbers == [list(range(45, 75)), list(range(75, 105)), list(range(105, 120))]


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_the_reported_frames_are_those_in_the_file_when_the_disk_is_full(tmp_path, share, caplog):
    whole, path = tmp_path / "whole.mcap", tmp_path / "run.mcap"
    frames = [small_frame(index) for index in range(30)]
    with begun(whole) as recording:
        for frame in frames:
            put(recording, frame)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    recording = begun(path)
    # The system refuses to let a file grow past this, as a full disk would.
    resource.setrlimit(resource.RLIMIT_FSIZE, (round(share * whole.stat().st_size), hard))
    try:
        for frame in frames:
            put(recording, frame)
        recording.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    there = len(recorded(path))
    assert 0 < there < 30
    assert (recording.state().frames, recording.state().lost) == (there, 30 - there)
    assert f"{there} frames are in the file" in caplog.text


def test_a_recording_that_is_deleted_is_said_once_and_ends(tmp_path, caplog):
    path = tmp_path / "run.mcap"
    with begun(path, split_s=1.0) as recording:
        for index in (0, 30):
            put(recording, small_frame(index))
        while recording.state().frames < 2:
            time.sleep(0.001)
        recording.state().files[-1].unlink()
        put(recording, *(small_frame(index) for index in range(31, 35)))
    assert recording.state().ended
    assert caplog.text.count("run-2.mcap was deleted or moved") == 1
    assert "run-2.mcap was deleted or moved" in recording.state().failure


def test_a_recording_without_frames_leaves_no_file(tmp_path):
    path = tmp_path / "run.mcap"
    with begun(path) as recording:
        assert path.exists()
    assert not path.exists()
    assert recording.state().frames == 0


def test_closing_gives_up_on_what_cannot_be_written_in_time_and_counts_it(path):
    pen = Pen(path, waits=True)
    recording = begun(path, pen)
    put(recording, *(small_frame(index) for index in range(5)))
    assert pen.began.wait(10)
    closing = threading.Thread(target=recording.close, args=(0.05,))
    closing.start()
    closing.join(0.5)
    pen.allowed.set()
    closing.join(10)
    assert pen.written == [0]
    assert (recording.state().frames, recording.state().lost) == (1, 4)
