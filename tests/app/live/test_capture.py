import threading

import pytest
from scripted_source import ScriptedSource, small_frame

from nurbseg.app.live.capture import CaptureThread, LatestSlot
from nurbseg.drivers.errors import DeviceLostError, FrameFormatError


def test_a_slot_hands_an_item_out_once() -> None:
    slot: LatestSlot[str] = LatestSlot()
    slot.put("a")
    assert slot.take(1.0) == "a"
    with pytest.raises(TimeoutError, match="within 0 s"):
        slot.take(0)


def test_a_newer_item_replaces_an_unseen_one_and_is_counted() -> None:
    slot: LatestSlot[int] = LatestSlot()
    for item in range(5):
        assert slot.put(item)
    assert slot.take(1.0) == 4
    assert slot.overwritten == 4


def test_a_slot_gives_its_last_item_before_it_says_that_it_is_finished() -> None:
    slot: LatestSlot[int] = LatestSlot()
    slot.put(1)
    slot.finish()
    assert [slot.take(1.0), slot.take(1.0)] == [1, None]


def test_an_error_of_the_producer_comes_out_after_its_last_item() -> None:
    slot: LatestSlot[int] = LatestSlot()
    slot.put(1)
    slot.finish(DeviceLostError("unplugged"))
    assert slot.take(1.0) == 1
    with pytest.raises(DeviceLostError, match="unplugged"):
        slot.take(1.0)


def test_a_closed_slot_takes_nothing_and_gives_nothing() -> None:
    slot: LatestSlot[int] = LatestSlot()
    slot.put(1)
    slot.close()
    assert not slot.put(2)
    assert slot.take(1.0) is None


def test_take_wakes_up_when_an_item_comes() -> None:
    slot: LatestSlot[int] = LatestSlot()
    taken: list[int | None] = []
    taker = threading.Thread(target=lambda: taken.append(slot.take(10.0)))
    taker.start()
    slot.put(7)
    taker.join(10.0)
    assert taken == [7]


def test_a_lossless_slot_makes_the_producer_wait() -> None:
    slot: LatestSlot[int] = LatestSlot(lossless=True)

    def produce() -> None:
        for item in range(50):
            slot.put(item)
        slot.finish()

    producer = threading.Thread(target=produce)
    producer.start()
    taken = list(iter(lambda: slot.take(10.0), None))
    producer.join(10.0)
    assert taken == list(range(50))
    assert slot.overwritten == 0


def test_closing_releases_a_producer_that_waits() -> None:
    slot: LatestSlot[int] = LatestSlot(lossless=True)
    slot.put(0)
    answers: list[bool] = []
    producer = threading.Thread(target=lambda: answers.append(slot.put(1)))
    producer.start()
    slot.close()
    producer.join(10.0)
    assert answers == [False]


def test_every_frame_comes_through_a_lossless_capture_in_order() -> None:
    frames = [small_frame(index) for index in range(20)]
    with ScriptedSource(frames) as source, CaptureThread(source, lossless=True) as capture:
        taken = [captured.frame for captured in iter(lambda: capture.frames.take(10.0), None)]
    assert taken == frames
    assert capture.read == 20
    assert source.readers == {"capture"}


def test_the_newest_frame_wins_and_the_others_are_counted() -> None:
    frames = [small_frame(index) for index in range(9)]
    with ScriptedSource(frames) as source, CaptureThread(source) as capture:
        capture._thread.join(10.0)
        newest = capture.frames.take(10.0)
        assert newest is not None
        assert newest.frame is frames[-1]
        assert capture.frames.take(10.0) is None
    assert (capture.read, capture.frames.overwritten) == (9, 8)


def test_damaged_frames_are_named_counted_and_passed_over(caplog: pytest.LogCaptureFixture) -> None:
    script = [small_frame(0), FrameFormatError("b_depth.png: 8 bits"), small_frame(2)]
    with ScriptedSource(script) as source, CaptureThread(source, lossless=True) as capture:
        taken = [captured.frame.index for captured in iter(lambda: capture.frames.take(10.0), None)]
    assert taken == [0, 2]
    assert capture.damaged == 1
    assert capture.damaged_frames == ["b_depth.png: 8 bits"]
    assert "skipped a damaged frame: b_depth.png: 8 bits" in caplog.text


def test_very_many_damaged_frames_are_named_only_at_first(caplog: pytest.LogCaptureFixture) -> None:
    script = [FrameFormatError(f"frame {index}") for index in range(100)]
    with ScriptedSource(script) as source, CaptureThread(source, lossless=True) as capture:
        assert capture.frames.take(10.0) is None
    assert capture.damaged == 100
    assert len(capture.damaged_frames) == 20
    assert len(caplog.records) == 21


@pytest.mark.parametrize("error", [DeviceLostError("gone"), MemoryError(), ZeroDivisionError()])
def test_an_error_in_the_thread_is_raised_where_frames_are_taken(error: Exception) -> None:
    with ScriptedSource([small_frame(0), error]) as source, CaptureThread(source, lossless=True) as capture:
        assert capture.frames.take(10.0) is not None
        with pytest.raises(type(error)):
            capture.frames.take(10.0)


def test_stopping_does_not_wait_for_a_camera_that_is_silent() -> None:
    never = threading.Event()
    with ScriptedSource([], live=True, released=never) as source:
        with CaptureThread(source) as capture, pytest.raises(TimeoutError):
            capture.frames.take(0.01)
        assert not capture._thread.is_alive()


def test_stopping_twice_is_harmless() -> None:
    with ScriptedSource([]) as source, CaptureThread(source) as capture:
        capture.stop()
        capture.stop()
