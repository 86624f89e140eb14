import threading
from dataclasses import replace

import numpy as np
import pytest
from child_python import run_python
from threadpoolctl import threadpool_info, threadpool_limits

from nurbseg.common.computer import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.methods import segment

# Sums over many rows and rows that do not divide evenly are what threads round differently.
_CHILD = """
import hashlib
import numpy as np
from nurbseg.common.computer import one_blas_thread
rng = np.random.default_rng(0)
digest = hashlib.sha256()
with one_blas_thread():
    for rows, columns in ((6000, 100), (2611, 73), (901, 31)):
        matrix = rng.random((rows, columns), dtype=np.float32)
        for product in (matrix.T @ matrix, np.ones(rows, dtype=np.float32) @ matrix, matrix @ matrix[0]):
            digest.update(np.ascontiguousarray(product).tobytes())
print(digest.hexdigest())
"""


def test_products_are_the_same_to_the_bit_on_any_number_of_threads():
    digests = set()
    for threads in ("1", "2", "3", "4"):
        environment = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads)
        digests.add(run_python(_CHILD, environment=environment).stdout)
    assert len(digests) == 1


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
