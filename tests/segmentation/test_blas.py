import threading
from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from nurbseg.common.computer import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.methods import segment


def threads() -> list[int]:
    return [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]


def test_the_number_of_threads_is_what_it_was_afterwards():
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert set(before) == {2}
        with one_blas_thread():
            assert set(threads()) == {1}
        assert threads() == before


@pytest.mark.parametrize("method", ["nurbseg", "stag15", "live"])
def test_a_frame_is_segmented_on_one_thread(cloud_of, method):
    seen = []

    def clock() -> float:
        seen.extend(threads())
        return 0.0

    cloud, config = cloud_of(np.ones((24, 32))), SegmentationConfig(budget_ms=1e6)
    live = LiveTree(config, clock=clock)
    with threadpool_limits(2, user_api="blas"):
        # A live tree that is begun, and one that is continued.
        for count in (1, 2):
            if method == "live":
                live.segment(cloud)
            else:
                segment(cloud, replace(config, method=method), clock=clock)
            assert len(seen) >= count
    assert {*seen} == {1}


def test_threads_that_segment_at_the_same_time_leave_the_number_of_threads():
    entered, leave = threading.Barrier(2, timeout=30.0), threading.Event()

    def first() -> None:
        with one_blas_thread():
            entered.wait()
            leave.wait(30.0)

    with threadpool_limits(2, user_api="blas"):
        other = threading.Thread(target=first)
        other.start()
        entered.wait()
        with one_blas_thread():
            leave.set()
            other.join(30.0)
            # The other thread has left its block, this one not.
            assert set(threads()) == {1}
        assert set(threads()) == {2}
