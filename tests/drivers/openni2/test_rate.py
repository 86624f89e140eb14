"""That a camera's rate is kept, also while this program is busy with other things."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from apart import apart
from busy_computer import slowdowns
from virtual_camera import frame_number

from nurbseg.drivers.options import DeviceOptions

#: A slow camera takes its time, and more than one try may be needed.
pytestmark = pytest.mark.timeout(1800)


class Busy:
    """Computes on the main thread's behalf until told to stop: arrays and plain Python by turns."""

    def __init__(self):
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work)
        self.rounds = 0

    def _work(self):
        rng = np.random.default_rng(0)
        matrix, points = rng.random((200, 200)), rng.random((100_000, 6), np.float32)
        while not self._stop.is_set():
            matrix = np.linalg.qr(matrix @ matrix.T)[0]
            order = np.argsort(points[:, self.rounds % 6])
            points = points[order]
            tree = {}
            for number in range(20_000):
                tree[number] = tree.get(number // 2, 0) + number
            self.rounds += 1

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


def lost(frames, wanted="any", *, fps=30, **options):
    """Read frames one after the other; return how many of the camera's were not among them."""
    with apart(wanted, DeviceOptions(**options)) as source:
        numbers = [frame_number(source.read(), fps) for _ in range(frames)]
        return numbers[-1] - numbers[0] + 1 - frames


def fewest_lost(cameras, read):
    """The best of a few tries, in which a busy computer's cameras are slower and slower."""
    tried = {}
    for slowdown in slowdowns():
        for camera in cameras:
            camera.set(slowdown=slowdown)
        tried[slowdown] = read()
        if tried[slowdown] == 0:
            break
    print(f"frames lost by slowdown: {tried}, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    return min(tried.values())


def test_sixty_frames_a_second_are_kept(virtual_cameras):
    modes = {"depth_mode": "qvga", "color_mode": "qvga"}
    assert fewest_lost([virtual_cameras.add()], lambda: lost(180, fps=60, **modes)) == 0


def test_no_frame_of_two_cameras_is_lost_in_ten_seconds_of_other_computing(virtual_cameras):
    cameras = [virtual_cameras.add(name, serial=name) for name in ("S1", "S2")]

    def read():
        with Busy() as busy, ThreadPoolExecutor(2) as readers:
            results = readers.map(lambda name, sync: lost(300, name, sync=sync), ("S1", "S2"), (True, False))
            result = sum(results)
        assert busy.rounds > 10
        return result

    assert fewest_lost(cameras, read) == 0
