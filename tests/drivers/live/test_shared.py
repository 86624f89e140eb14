"""Several readers of one camera: frames are released one by one, and time is a fake clock's."""

import queue
import subprocess
import sys
import threading

import pytest
from fake_clock import FakeClock
from scripted_source import CALIBRATION, small_frame

from nurbseg.common.errors import DeviceLostError, DriverError, FrameFormatError, FrameTimeoutError
from nurbseg.drivers.live import shared
from nurbseg.drivers.live.shared import SharedCamera
from nurbseg.drivers.source import FrameSource


class ReleasedSource(FrameSource):
    """A camera that delivers what `give` is given, which returns when all readers have it."""

    live = True

    def __init__(self):
        super().__init__()
        self.calibration = CALIBRATION
        self.metadata = {"device": "A camera"}
        self.closed = threading.Event()
        self._entries = queue.Queue()
        self._taken = False

    def give(self, *entries):
        for entry in entries:
            self._entries.put(entry)
        self._entries.join()

    def _read(self, timeout_s):
        if self._taken:
            # The one before was passed on.
            self._taken = False
            self._entries.task_done()
        try:
            entry = self._entries.get(timeout=timeout_s)
        except queue.Empty:
            raise FrameTimeoutError(f"A camera: no depth and color within {timeout_s:g} s") from None
        if isinstance(entry, DeviceLostError):
            self._entries.task_done()
            raise entry
        self._taken = True
        if isinstance(entry, Exception):
            raise entry
        return small_frame(entry)

    def _close(self):
        self.closed.set()


@pytest.fixture
def source():
    return ReleasedSource()


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def camera(source, clock):
    with SharedCamera(source, clock=clock) as shared_camera:
        yield shared_camera


def begun(reader, source):
    """Make a reader take part; return its first frame."""
    thread = threading.Thread(target=source.give, args=(0,))
    thread.start()
    frame = reader.read(10.0)
    thread.join()
    return frame


def test_a_slow_loop_has_the_newest_frame_and_the_others_are_missed(camera, source):
    assert begun(camera, source).index == 0
    source.give(*range(1, 10))
    assert camera.read(0.0).index == 9
    assert camera.missed == 8
    source.give(10)
    assert camera.read(0.0).index == 10
    assert camera.missed == 8


def test_iterating_is_reading_the_newest(camera, source):
    begun(camera, source)
    numbers = []
    for frame in (loop := iter(camera)) if source.give(1, 2, 3) is None else ():
        numbers.append(frame.index)
        if len(numbers) == 3:
            break
        source.give(*range(frame.index + 1, frame.index + 6))
    loop.close()
    assert numbers == [3, 8, 13]
    assert camera.missed == 10


def test_each_of_two_readers_has_its_newest(camera, source):
    begun(camera, source)
    other = camera.reader()
    with pytest.raises(FrameTimeoutError):
        other.read(0.0)
    source.give(1, 2)
    assert camera.read(0.0).index == 2
    source.give(3)
    assert other.read(0.0).index == 3
    assert camera.read(0.0).index == 3
    # It came later, and read its first frame then.
    assert (camera.missed, other.missed) == (1, 0)


def test_a_recorder_beside_a_slow_loop_has_every_frame(camera, source):
    begun(camera, source)
    recorder = camera.reader(every=True)
    with pytest.raises(FrameTimeoutError):
        recorder.read(0.0)
    source.give(*range(1, 31))
    assert camera.read(0.0).index == 30
    assert [recorder.read(0.0).index for _ in range(30)] == list(range(1, 31))
    assert (camera.missed, recorder.missed) == (29, 0)
    assert recorder.losses == {"missed": 0}


def test_what_waits_for_a_recorder_is_limited_and_what_is_over_it_counted(camera, source, monkeypatch):
    frame = small_frame(0)
    monkeypatch.setattr(shared, "_WAITING_BYTES", 5 * (frame.depth_mm.nbytes + frame.color.nbytes))
    recorder = camera.reader(every=True)
    assert begun(recorder, source).index == 0
    source.give(*range(1, 21))
    assert [recorder.read(0.0).index for _ in range(5)] == [16, 17, 18, 19, 20]
    assert recorder.missed == 15
    assert recorder.losses == {"missed": 15}


def test_the_newest_frame_is_returned_again_and_again_until_it_is_stale(camera, source, clock):
    begun(camera, source)
    source.give(1)
    clock.now_s += 0.25
    for _ in range(2):
        assert camera.latest(250.0).index == 1
    with pytest.raises(FrameTimeoutError, match="came 250 ms ago, over 249 ms"):
        camera.latest(249.0)
    # It is still to be read.
    assert camera.read(0.0).index == 1
    assert camera.reader().latest(250.0).index == 1
    source.give(2)
    assert camera.latest(0.0).index == 2


def test_the_newest_frame_is_not_waited_for(camera, source):
    with pytest.raises(FrameTimeoutError, match="A camera: no frame yet"):
        camera.latest(1000.0)
    # But the camera has begun.
    source.give(0)
    assert camera.latest(1000.0).index == 0


def test_frames_before_the_first_read_are_not_missed(camera, source):
    with pytest.raises(FrameTimeoutError):
        camera.latest(0.0)
    source.give(0, 1, 2)
    with pytest.raises(FrameTimeoutError, match=r"A camera: no frame within 0 s"):
        camera.read(0.0)
    source.give(3)
    assert camera.read(0.0).index == 3
    assert camera.missed == 0


def test_a_lost_camera_is_lost_for_each_reader_after_its_last_frame(camera, source):
    begun(camera, source)
    other = camera.reader()
    source.give(1, DeviceLostError("A camera was unplugged"))
    assert camera.read(10.0).index == 1
    for reader in (camera, other):
        for _ in range(2):
            with pytest.raises(DeviceLostError, match="unplugged"):
                reader.read(10.0)
    with pytest.raises(DeviceLostError, match="unplugged"):
        camera.latest(1e6)
    assert not camera.connected


def test_a_damaged_frame_is_raised_once_and_no_frame(camera, source):
    begun(camera, source)
    source.give(FrameFormatError("depth frame 7: cut off"))
    with pytest.raises(FrameFormatError, match="frame 7"):
        camera.read(0.0)
    assert camera.latest(1.0).index == 0
    source.give(1)
    assert camera.read(0.0).index == 1
    assert camera.missed == 0


def test_a_closed_reader_leaves_the_camera_to_the_others(camera, source):
    begun(camera, source)
    with camera.reader() as other, pytest.raises(FrameTimeoutError):
        other.read(0.0)
    with pytest.raises(DriverError, match="closed"):
        other.read(0.0)
    source.give(1)
    assert camera.read(0.0).index == 1


def test_closing_the_camera_ends_a_read_that_waits_in_another_thread(camera, source):
    begun(camera, source)
    other = camera.reader()
    raised = []

    def wait():
        try:
            other.read(60.0)
        except DriverError as err:
            raised.append(str(err))

    thread = threading.Thread(target=wait)
    thread.start()
    camera.close()
    thread.join(10.0)
    assert raised == ["A camera is closed"]
    assert source.closed.is_set()
    for call in (camera.read, other.read, lambda: camera.latest(1.0)):
        with pytest.raises(DriverError, match="closed"):
            call()


def test_a_program_that_forgets_to_close_a_camera_ends():
    code = """
from scripted_source import ScriptedSource, small_frame
from nurbseg.common.errors import FrameTimeoutError
from nurbseg.drivers.live.shared import SharedCamera
import time
script = [small_frame(0)] + 10_000 * [FrameTimeoutError("nothing")]
class Slow(ScriptedSource):
    def _read(self, timeout_s):
        time.sleep(timeout_s)
        return super()._read(timeout_s)
camera = SharedCamera(Slow(script, live=True))
print(camera.read(10.0).index)
"""
    words = [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}\n{code}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "0\n", done.stderr
