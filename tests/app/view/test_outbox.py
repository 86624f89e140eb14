from __future__ import annotations

import threading
import time

import pytest

from nurbseg.app.view.outbox import Outbox


def test_a_lossy_outbox_keeps_the_newest_frames_and_counts_the_others() -> None:
    outbox: Outbox[int] = Outbox(2, lossless=False)
    for frame in range(5):
        outbox.put(frame, timeout_s=0.0)
    assert outbox.dropped == 3
    assert outbox.take(0.0) == [3]
    assert outbox.take(0.0) == [4]
    assert outbox.take(0.0) == []


def test_a_lossless_outbox_refuses_a_frame_that_has_no_room_and_drops_none() -> None:
    outbox: Outbox[int] = Outbox(2, lossless=True)
    outbox.put(0, timeout_s=0.0)
    outbox.put(1, timeout_s=0.0)
    with pytest.raises(TimeoutError, match=r"no room for a frame within 0\.01 s"):
        outbox.put(2, timeout_s=0.01)
    assert [outbox.take(0.0), outbox.take(0.0), outbox.take(0.0)] == [[0], [1], []]
    assert outbox.dropped == 0


def test_a_waiting_put_goes_on_as_soon_as_there_is_room() -> None:
    outbox: Outbox[int] = Outbox(1, lossless=True)
    outbox.put(0, timeout_s=0.0)
    thread = threading.Thread(target=outbox.put, args=(1, 10.0))
    thread.start()
    assert outbox.take(1.0) == [0]
    thread.join(5.0)
    assert not thread.is_alive()
    assert outbox.take(1.0) == [1]


def test_lines_come_before_the_frame_and_never_take_its_room() -> None:
    outbox: Outbox[str] = Outbox(1, lossless=True)
    outbox.put("frame", timeout_s=0.0)
    outbox.put_line("first")
    outbox.put_line("second")
    assert outbox.take(0.0) == ["first", "second", "frame"]


def test_of_very_many_lines_the_oldest_are_dropped_without_waiting() -> None:
    outbox: Outbox[int] = Outbox(1, lossless=True)
    for line in range(5000):
        outbox.put_line(line)
    due = outbox.take(0.0)
    assert due == list(range(4000, 5000))


def test_closing_wakes_the_taker_and_what_waits_can_still_be_taken() -> None:
    outbox: Outbox[int] = Outbox(2, lossless=True)
    taken: list[list[int]] = []
    thread = threading.Thread(target=lambda: taken.append(outbox.take(30.0)))
    thread.start()
    outbox.close()
    thread.join(5.0)
    assert taken == [[]]

    outbox = Outbox(2, lossless=True)
    outbox.put(7, timeout_s=0.0)
    outbox.close()
    outbox.put(8, timeout_s=0.0)
    assert not outbox.finished
    assert outbox.take(0.0) == [7]
    assert outbox.finished


def test_closing_frees_a_put_that_waits() -> None:
    outbox: Outbox[int] = Outbox(1, lossless=True)
    outbox.put(0, timeout_s=0.0)
    thread = threading.Thread(target=outbox.put, args=(1, 30.0))
    thread.start()
    began_s = time.monotonic()
    outbox.close()
    thread.join(5.0)
    assert time.monotonic() - began_s < 5.0
    assert outbox.take(0.0) == [0]


def test_an_outbox_without_room_is_refused() -> None:
    with pytest.raises(ValueError, match="capacity: expected at least 1 frame, got 0"):
        Outbox(0, lossless=True)
