"""A source that outlasts its camera, with a scripted camera and a clock of our own."""

from collections import deque

import numpy as np
import pytest

from nurbseg.common.errors import (
    DeviceLostError,
    DeviceNotFoundError,
    FrameFormatError,
    FrameTimeoutError,
)
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.drivers.process.messages import Lost, Opened, Status
from nurbseg.drivers.process.reconnecting import Reconnecting
from nurbseg.drivers.source import FrameSource

CALIBRATION = Calibration.registered(Intrinsics(4, 3, 5.0, 5.0, 1.5, 1.0))


class Clock:
    """Time passes only by sleeping."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s

    def sleep(self, seconds):
        assert seconds >= 0
        self.now_s += max(seconds, 1e-6)


class Camera(FrameSource):
    """Delivers frames 0, 1, ... of a clock that starts at `begin_ns`, then is lost."""

    live = True

    def __init__(self, clock, frames, begin_ns=0, name="camera"):
        super().__init__()
        self.calibration = CALIBRATION
        self.metadata["device"] = name
        self.left = deque(range(frames))
        self.begin_ns = begin_ns
        self.clock = clock

    def _read(self, timeout_s):
        if not self.left:
            raise DeviceLostError("unplugged")
        self.clock.sleep(0.1)
        index = self.left.popleft()
        depth = np.zeros((3, 4), np.uint16)
        color = np.zeros((3, 4, 3), np.uint8)
        return RGBDFrame(index, self.begin_ns + index * 100_000_000, depth, color, CALIBRATION)

    def _close(self):
        pass


class World:
    """What opening the camera finds, one thing a try: a camera, or None while it is away."""

    def __init__(self, clock, found):
        self.found = deque(found)
        self.clock = clock
        self.tries_s = []

    def open(self):
        self.tries_s.append(self.clock())
        camera = self.found.popleft() if self.found else None
        if camera is None:
            raise DeviceNotFoundError("away")
        return camera


def reconnecting(clock, first, world, interval_s=0.5):
    return Reconnecting(first, world.open, interval_s=interval_s, clock=clock, sleep=clock.sleep)


def test_frames_go_on_with_index_and_time():
    clock = Clock()
    world = World(clock, [None, None, Camera(clock, 3, begin_ns=7)])
    with reconnecting(clock, Camera(clock, 2, begin_ns=5_000), world) as source:
        frames = [source.read(timeout_s=5.0) for _ in range(5)]
        assert source.reconnections == 1
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    seconds = np.diff([frame.timestamp_ns for frame in frames]) * 1e-9
    # Two tries half a second apart and the next frame's own tenth.
    np.testing.assert_allclose(seconds, [0.1, 1.1, 0.1, 0.1], atol=1e-4)
    assert frames[0].timestamp_ns == 5_000


def test_a_camera_that_is_away_is_a_timeout_and_looked_for_at_intervals():
    clock = Clock()
    world = World(clock, [])
    with reconnecting(clock, Camera(clock, 1), world) as source:
        source.read()
        for _ in range(3):
            begun_s = clock()
            with pytest.raises(FrameTimeoutError, match=r"disconnected: no frame within 0\.7 s"):
                source.read(timeout_s=0.7)
            assert clock() - begun_s == pytest.approx(0.7, abs=1e-3)
        assert not source.connected
    np.testing.assert_allclose(np.diff(world.tries_s), 0.5, atol=0.21)


def test_a_camera_that_is_lost_soon_after_its_return_is_found_at_once_again():
    clock = Clock()
    world = World(clock, [Camera(clock, 1), Camera(clock, 1)])
    with reconnecting(clock, Camera(clock, 0), world, interval_s=60.0) as source:
        assert [source.read(timeout_s=0.5).index for _ in range(2)] == [0, 1]


def test_a_camera_whose_process_has_ended_is_looked_for_and_goes_on_after_its_last_frame():
    clock = Clock()
    lost = Lost(
        Status(losses={"missed": 2, "reconnections": 1}),
        Opened(CALIBRATION, {"device": "camera"}, None, live=True, seekable=False),
        fruitless=1,
        index=6,
        timestamp_ns=5_000,
        arrived_s=99.5,
    )
    world = World(clock, [None, Camera(clock, 2)])
    with Reconnecting(lost, world.open, clock=clock, sleep=clock.sleep) as source:
        assert not source.connected
        frames = [source.read(timeout_s=5.0) for _ in range(2)]
        assert source.connected
        assert source.losses == {"missed": 2, "reconnections": 2}
    assert [frame.index for frame in frames] == [7, 8]
    # Half a second had passed; it was tried after one and after half a second, and a frame takes a tenth.
    assert frames[0].timestamp_ns == pytest.approx(5_000 + 2.1e9, abs=1e5)


def test_no_time_to_wait_still_means_one_try():
    clock = Clock()
    world = World(clock, [Camera(clock, 1)])
    with reconnecting(clock, Camera(clock, 0), world) as source:
        assert source.read(timeout_s=0.0).index == 0


def test_the_lost_source_is_closed_before_the_camera_is_opened_again():
    clock = Clock()
    lost = Camera(clock, 0)

    class Checking(World):
        def open(self):
            assert lost._closed
            return super().open()

    with reconnecting(clock, lost, Checking(clock, [Camera(clock, 1)])) as source:
        source.read()


def test_errors_other_than_loss_pass_through():
    clock = Clock()

    class Slow(Camera):
        def _read(self, timeout_s):
            raise FrameTimeoutError("slow")

    with reconnecting(clock, Slow(clock, 0), World(clock, [])) as source:
        with pytest.raises(FrameTimeoutError, match="slow"):
            source.read()
        assert source.connected


def test_a_camera_lost_again_and_again_is_taken_up_each_time():
    clock = Clock()
    world = World(clock, [Camera(clock, 1) for _ in range(9)])
    with reconnecting(clock, Camera(clock, 1), world) as source:
        frames = [source.read(timeout_s=1.0) for _ in range(10)]
        assert source.reconnections == 9
    assert [frame.index for frame in frames] == list(range(10))
    assert np.all(np.diff([frame.timestamp_ns for frame in frames]) > 0)


def test_metadata_is_that_of_the_camera_in_use():
    clock = Clock()
    world = World(clock, [Camera(clock, 1, name="second")])
    with reconnecting(clock, Camera(clock, 0, name="first"), world) as source:
        assert source.metadata["device"] == "first"
        source.read()
        assert source.metadata["device"] == "second"


def test_a_camera_that_comes_back_with_another_registration_is_said_so(caplog):
    clock = Clock()
    apart, same = Camera(clock, 1), Camera(clock, 1)
    offset = np.eye(4)
    offset[0, 3] = -0.025
    apart.calibration = Calibration(CALIBRATION.depth, CALIBRATION.color, offset)
    with reconnecting(clock, Camera(clock, 0), World(clock, [same, apart])) as source:
        told = source.metadata
        source.read()
        assert "register" not in caplog.text
        source.read()
        assert source.calibration is apart.calibration
        assert source.metadata is told
    assert "camera now does not register depth to color, unlike before" in caplog.text


def test_a_camera_that_comes_back_without_a_frame_is_reopened_less_and_less_often():
    clock = Clock()
    world = World(clock, [Camera(clock, 0) for _ in range(10)])
    with Reconnecting(Camera(clock, 3), world.open, interval_s=0.5, clock=clock, sleep=clock.sleep) as source:
        for _ in range(3):
            source.read()
        lost_s = clock()
        with pytest.raises(FrameTimeoutError):
            source.read(120.0)
        steps_s = np.diff([lost_s, *world.tries_s])
        np.testing.assert_allclose(steps_s, [0, 1, 2, 4, 8, 16, 30, 30], atol=0.01)
        # A frame, and the next one is looked for at once again.
        world.found = deque([Camera(clock, 1), Camera(clock, 1)])
        source.read(60.0)
        tried_s = clock()
        source.read(60.0)
        assert world.tries_s[-1] - tried_s < 0.01


def test_a_damaged_frame_does_not_lose_the_camera():
    clock = Clock()
    camera = Camera(clock, 2)
    with Reconnecting(camera, World(clock, []).open, clock=clock, sleep=clock.sleep) as source:
        source.read()
        read, camera._read = camera._read, damaged
        with pytest.raises(FrameFormatError):
            source.read()
        camera._read = read
        assert source.read().index == 1
        assert source.connected


def damaged(timeout_s):
    raise FrameFormatError("color frame 7: too short")
