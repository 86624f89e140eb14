"""Segments keep their labels from frame to frame, in files, figures and pictures."""

import inspect
import pickle
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest
from types import FrameType, SimpleNamespace
from typing import Any, Self

import numpy as np
import pytest
from fake_clock import FakeClock
from rendered import rendered

from nurbseg.app.export.tree import tree_document
from nurbseg.app.settings.app_config import LiveConfig
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.player import Player
from nurbseg.drivers.registry import open_source
from nurbseg.library import segmenter as segmenter_module
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation import methods
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.tree import Budget, UpdateReport
from nurbseg.segmentation.points.registration import PointMap, Registration
from nurbseg.segmentation.vocabulary import StopReason


def frames_of(frames: int, size: str = "width=160&height=120") -> list[RGBDFrame]:
    """Read the frames of a rendered recording."""
    with open_source(rendered(f"{size}&frames={frames}")) as source:
        return list(source)


@pytest.mark.parametrize(
    ("temporal", "every_frame", "follows"),
    [("auto", False, True), ("auto", True, False), ("on", True, True), ("off", False, False)],
)
def test_frames_follow_each_other_where_the_newest_is_taken(
    temporal: str, every_frame: bool, follows: bool
) -> None:
    assert LiveConfig(temporal=temporal).follows(every_frame=every_frame) is follows  # type: ignore[arg-type]


@pytest.mark.parametrize("method", ["stag15", "nurbseg"])
def test_labels_are_identities_and_the_tree_has_them(method: str) -> None:
    segmenter = Segmenter(SegmentationConfig(method=method), temporal=True)  # type: ignore[arg-type]
    results = [segmenter.process(frame) for frame in frames_of(3)]
    for result in results:
        assert "identify" in result.elapsed_ms
        document = tree_document(result, "mse")
        surfaces = {segment["leaf"] for segment in document["segments"] if not segment["children"]}
        assert set(np.unique(result.labels("surfaces"))) - {0} == surfaces - {0}
        assert set(np.unique(result.labels())) - {0} == {
            segment["label"] for segment in document["segments"] if segment["label"]
        }
        if result.tree.objects:
            assert {each["object"] for each in document["objects"]} == set(result.object_labels)
    # What one frame calls a segment, the next one calls it too.
    first, second = (result.labels() for result in results[:2])
    both = (first > 0) & (second > 0)
    assert np.mean(first[both] == second[both]) > 0.5


def test_stages_are_timed_in_milliseconds(monkeypatch: pytest.MonkeyPatch, small_result: FrameResult) -> None:
    clock = FakeClock()

    def taking(seconds: float, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **options: Any) -> Any:
            clock.sleep(seconds)
            return work(*given, **options)

        return run

    monkeypatch.setattr(segmenter_module, "time", SimpleNamespace(perf_counter=clock))
    monkeypatch.setattr(Registration, "register", taking(0.25, Registration.register))
    for module, name, seconds in ((methods, "segment", 0.5), (segmenter_module, "track_identities", 0.125)):
        monkeypatch.setattr(module, name, taking(seconds, getattr(module, name)))
    segmenter = Segmenter(SegmentationConfig(method="stag15"), temporal=True)
    found = segmenter.process(small_result.frame).elapsed_ms
    assert dict(found) == pytest.approx({"register": 250.0, "segment": 500.0, "identify": 125.0})


def test_after_a_restart_what_is_still_there_keeps_its_label() -> None:
    segmenter = Segmenter(SegmentationConfig(), temporal=True)
    frames = frames_of(2)
    first = segmenter.process(frames[0])
    segmenter.restart("a jump")
    second = segmenter.process(frames[1])
    assert second.update is not None
    assert second.update.reset == "a jump"
    both = (first.labels() > 0) & (second.labels() > 0)
    assert np.mean(first.labels()[both] == second.labels()[both]) > 0.5


def test_only_the_first_frame_after_a_jump_in_a_replay_is_segmented_from_scratch() -> None:
    segmenter = Segmenter(SegmentationConfig(), temporal=True)
    with Player(open_source(rendered("width=160&height=120&frames=4"))) as player:
        updates = [segmenter.process(player.read()).update]
        player.seek(2)
        updates += [segmenter.process(frame).update for frame in player]
    resets = [update and update.reset for update in updates]
    assert resets == ["first frame", "a jump to another frame", ""]


@pytest.mark.parametrize("back", [{"index": 0}, {"timestamp_ns": 5}])
def test_numbers_or_stamps_that_go_back_begin_a_new_sequence(
    back: dict[str, int], caplog: pytest.LogCaptureFixture
) -> None:
    segmenter = Segmenter(SegmentationConfig(), temporal=True)
    frames = frames_of(2)
    first, second = (replace(frame, index=7 + n, timestamp_ns=10 + n) for n, frame in enumerate(frames))
    results = [segmenter.process(frame) for frame in (first, second, second, replace(second, **back))]
    results += [segmenter.process(replace(second, index=0, timestamp_ns=1))]
    begun = ["restart" in {event.kind for event in result.events} for result in results]
    assert begun == [False, False, False, True, True]
    assert [result.update is not None and result.update.reset != "" for result in results[1:]] == begun[1:]
    (message,) = caplog.messages
    assert "numbers or stamps that go back; here and from now on, a new sequence begins" in message


def followed(segmenter: Segmenter, waits_ms: Sequence[float] = ()) -> list[tuple[UpdateReport, int]]:
    """What was done in each frame that follows another, and how many of its surfaces are pending."""
    done = []
    moving = frames_of(6, "width=320&height=240")
    for frame, waited_ms in zip_longest(moving, waits_ms, fillvalue=0.0):
        result = segmenter.process(frame, waited_ms=waited_ms)
        assert result.update is not None
        pending = sum(leaf.stop is StopReason.PENDING for leaf in result.tree.leaves())
        done.append((result.update, pending))
    assert done[0][0].reset == "first frame"
    assert not any(update.reset for update, _ in done[1:])
    return done[1:]


def test_a_late_frame_is_updated_less() -> None:
    segmenter = Segmenter(SegmentationConfig(), target_hz=30.0)
    updates = [update for update, _ in followed(segmenter, [0.0] * 4 + [25.0] * 2)]
    in_time, late = updates[:3], updates[3:]
    assert 0 < max(update.trials for update in late) < min(update.trials for update in in_time)
    assert max(update.judged for update in late) < min(update.judged for update in in_time)


@pytest.mark.parametrize("target_hz", [0.0, 1e-3])
def test_no_more_is_tried_in_a_frame_than_was_asked_for_and_the_rest_is_pending(target_hz: float) -> None:
    done = followed(Segmenter(SegmentationConfig(), trials_max=2, target_hz=target_hz))
    assert max(update.trials for update, _ in done) == 2
    assert [pending for _, pending in done] == [update.waiting for update, _ in done]
    # Nothing waits unless as much was tried as is allowed.
    assert {update.trials for update, pending in done if pending} == {2}


def test_without_a_limit_nothing_is_pending() -> None:
    done = followed(Segmenter(SegmentationConfig(), trials_max=0))
    assert max(update.trials for update, _ in done) > Budget().trials
    assert not any(pending or update.waiting for update, pending in done)


def test_without_it_labels_are_places_in_the_tree() -> None:
    result = Segmenter(SegmentationConfig(), temporal=False).process(frames_of(1)[0])
    assert np.array_equal(result.labels(), result.tree.labels())
    assert result.surface_labels == tuple(range(1, len(result.tree.leaves()) + 1))
    assert result.events == ()


class Interruption:
    """Interrupts the program, as Ctrl-C does, at the n-th call of a function.

    Not of a generator: Python ignores what it raises while it is closed.
    """

    def __init__(self, calls: int) -> None:
        self.left = calls

    def __enter__(self) -> Self:
        sys.setprofile(self._count)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def _count(self, frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and not frame.f_code.co_flags & inspect.CO_GENERATOR:
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt


def test_a_frame_that_was_interrupted_anywhere_leaves_the_next_ones_as_good() -> None:
    frames = frames_of(6)
    segmenter = Segmenter()
    for frame in frames[:2]:
        segmenter.process(frame)
    with Interruption(0) as counted:
        segmenter.process(frames[2])
    alone = Segmenter().process(frames[3]).labels("surfaces")
    for part in (0.02, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97, 0.99):
        segmenter = Segmenter()
        for frame in frames[:2]:
            segmenter.process(frame)
        # Where a compiled function calls Python, an interruption becomes another error.
        with pytest.raises((KeyboardInterrupt, SystemError)), Interruption(int(part * -counted.left)):
            segmenter.process(frames[2])
        result = segmenter.process(frames[3])
        assert result.update is not None and result.update.reset == "an interruption"
        labels = result.labels("surfaces")
        # The same regions, whatever their labels are.
        pairs = len(np.unique(np.stack([labels.ravel(), alone.ravel()]), axis=1).T)
        assert pairs == len(np.unique(labels)) == len(np.unique(alone))
        following = segmenter.process(frames[4])
        assert following.update is not None and following.update.reset == ""


def test_a_segmenter_is_refused_to_a_second_thread_while_the_first_is_in_a_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (frame,) = frames_of(1)
    segmenter, inside, go = Segmenter(), threading.Event(), threading.Event()
    register = Registration.register

    def slow(self: Registration, frame: RGBDFrame) -> PointMap:
        inside.set()
        assert go.wait(30.0)
        return register(self, frame)

    monkeypatch.setattr(Registration, "register", slow)
    first = threading.Thread(target=segmenter.process, args=[frame])
    first.start()
    assert inside.wait(30.0)
    with pytest.raises(RuntimeError, match="used by another thread"):
        segmenter.process(frame)
    go.set()
    first.join(60.0)
    assert segmenter.process(frame).update.reset == ""  # type: ignore[union-attr]


def test_a_result_of_a_sequence_can_be_pickled() -> None:
    segmenter = Segmenter()
    result = [segmenter.process(frame) for frame in frames_of(2, "width=640&height=480")][-1]
    copy = pickle.loads(pickle.dumps(result))
    assert np.array_equal(copy.labels(), result.labels())
    assert [each.label for each in copy.objects] == [each.label for each in result.objects] != []
    assert np.array_equal(copy.objects[0].box.size_m, result.objects[0].box.size_m)
    assert copy.events == result.events and copy.lost_objects == result.lost_objects
    assert copy.elapsed_ms == result.elapsed_ms and copy.tree.leaves()[0].name == result.tree.leaves()[0].name


def test_a_tree_that_is_read_later_is_that_of_its_own_frame() -> None:
    at_once, later = Segmenter(), Segmenter()
    with open_source(rendered("frames=3")) as source:
        frames = list(source)
    read = [tree_document(at_once.process(frame), "mse") for frame in frames]
    results = [later.process(frame) for frame in frames]
    assert [tree_document(result, "mse") for result in results] == read
