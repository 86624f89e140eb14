from __future__ import annotations

import threading

import pytest

from nurbseg.common.process.bounded_queue import BoundedQueue


def taken_in_thread(queue: BoundedQueue[int]) -> tuple[threading.Thread, list[int | None]]:
    taken: list[int | None] = []
    thread = threading.Thread(target=lambda: taken.append(queue.take(30.0)))
    thread.start()
    return thread, taken


def put_in_thread(queue: BoundedQueue[int], item: int) -> tuple[threading.Thread, list[bool]]:
    answers: list[bool] = []
    thread = threading.Thread(target=lambda: answers.append(queue.put(item)))
    thread.start()
    return thread, answers


def test_where_the_newest_wins_the_oldest_are_dropped_and_counted() -> None:
    queue: BoundedQueue[int] = BoundedQueue(2, "drop oldest")
    for item in range(5):
        assert queue.put(item, timeout_s=0.0)
    assert queue.dropped == 3
    assert [queue.take(0.0), queue.take(0.0)] == [3, 4]
    with pytest.raises(TimeoutError, match="nothing came within 0 s"):
        queue.take(0.0)


def test_where_new_items_are_refused_those_that_wait_are_kept() -> None:
    queue: BoundedQueue[int] = BoundedQueue(2, "refuse")
    assert [queue.put(item) for item in range(4)] == [True, True, False, False]
    assert queue.dropped == 2
    assert [queue.take(0.0), queue.take(0.0)] == [0, 1]


def test_a_producer_that_waits_gives_up_in_time_and_nothing_is_dropped() -> None:
    queue: BoundedQueue[int] = BoundedQueue(2, "wait")
    queue.put(0)
    queue.put(1)
    with pytest.raises(TimeoutError, match=r"no room within 0\.01 s"):
        queue.put(2, timeout_s=0.01)
    assert [queue.take(0.0), queue.take(0.0)] == [0, 1]
    assert queue.dropped == 0


def test_a_waiting_producer_continues_as_soon_as_there_is_room() -> None:
    queue: BoundedQueue[int] = BoundedQueue(1, "wait")

    def produce() -> None:
        for item in range(50):
            queue.put(item, 10.0)
        queue.close()

    producer = threading.Thread(target=produce)
    producer.start()
    taken = list(iter(lambda: queue.take(10.0), None))
    producer.join(10.0)
    assert taken == list(range(50))
    assert queue.dropped == 0


def test_room_goes_by_size_and_an_empty_queue_has_room_for_anything() -> None:
    queue: BoundedQueue[bytes] = BoundedQueue(10, "refuse", len)
    assert queue.put(bytes(6))
    assert not queue.put(bytes(5))
    assert queue.put(bytes(4))
    assert not queue.put(bytes(1))
    queue.take(0.0)
    queue.take(0.0)
    assert queue.put(bytes(1000))


def test_notes_come_before_items_and_never_take_their_room() -> None:
    queue: BoundedQueue[str] = BoundedQueue(1, "wait")
    queue.put("frame")
    queue.put_urgent("first")
    queue.put_urgent("second")
    assert [queue.take(0.0) for _ in range(3)] == ["first", "second", "frame"]


def test_of_very_many_notes_the_oldest_are_dropped_without_waiting() -> None:
    queue: BoundedQueue[int] = BoundedQueue(1, "wait")
    for note in range(5000):
        queue.put_urgent(note)
    queue.close()
    assert list(iter(lambda: queue.take(0.0), None)) == list(range(4000, 5000))


def test_closing_wakes_the_taker() -> None:
    queue: BoundedQueue[int] = BoundedQueue(2, "wait")
    thread, taken = taken_in_thread(queue)
    queue.close()
    thread.join(10.0)
    assert taken == [None]


def test_what_waits_when_it_is_closed_can_still_be_taken_and_nothing_follows() -> None:
    queue: BoundedQueue[int] = BoundedQueue(2, "wait")
    queue.put(7)
    queue.close()
    assert not queue.put(8)
    queue.put_urgent(9)
    assert queue.closed
    assert not queue.finished
    assert [queue.take(0.0), queue.take(0.0)] == [7, None]
    assert queue.finished


@pytest.mark.parametrize("end", [BoundedQueue.close, BoundedQueue.discard])
def test_the_end_frees_a_producer_that_waits(end: object) -> None:
    queue: BoundedQueue[int] = BoundedQueue(1, "wait")
    queue.put(0)
    thread, answers = put_in_thread(queue, 1)
    assert callable(end)
    end(queue)
    thread.join(10.0)
    assert answers == [False]


def test_what_is_discarded_is_counted() -> None:
    queue: BoundedQueue[int] = BoundedQueue(3, "wait")
    queue.put(0)
    queue.put(1)
    queue.close()
    assert queue.discard() == 2
    assert queue.take(0.0) is None
