"""Corrections by commands: of the paused frame alone, shown at once, and not lost unasked."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scripted_source import NumberedSource
from small_scene import CONFIG, small_frame, small_result

from nurbseg.app.live.capture import CaptureThread
from nurbseg.app.live.control.controls import Controls
from nurbseg.app.live.control.corrections import Corrections
from nurbseg.app.recording.recorder import Recorder
from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.app.view.view import View
from nurbseg.drivers.player import Player
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame


class Shown(View):
    """Remembers the frames that it was shown, and whether each was to be shown in full."""

    every_frame_in_full = False

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[FrameResult] = []

    def show(self, result: FrameResult) -> None:
        assert self.every_frame_in_full
        self.frames.append(result)


@pytest.fixture
def view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Shown:
    monkeypatch.chdir(tmp_path)
    return Shown()


@pytest.fixture
def corrections(view: Shown) -> Corrections:
    return Corrections("/data/kitchen day.mcap", view)


@pytest.fixture
def player() -> Iterator[Player]:
    with Player(NumberedSource(1000)) as player:
        yield player


@pytest.fixture
def controls(corrections: Corrections, player: Player) -> Controls:
    recorder = Recorder(RecordConfig(), player)
    return Controls(CONFIG, player, CaptureThread(player), recorder, corrections=corrections)


def said(controls: Controls, command: str) -> tuple[str, bool]:
    controls.apply(command)
    state = controls.state()
    return state.said, state.refused


def test_what_is_corrected_is_shown_at_once_and_saved_beside_the_frame(
    controls: Controls, corrections: Corrections, view: Shown, tmp_path: Path
) -> None:
    result = corrections.meet(small_result(3))
    before = result.labels("objects")
    controls.apply("pause")
    assert said(controls, "merge 1 2") == ("merged 2 into 1: 1 objects", False)
    assert np.array_equal(view.frames[-1].labels("objects"), (before > 0).astype(np.uint16))
    assert said(controls, "split 1") == ("split 2 from 1: 2 objects", False)
    assert np.array_equal(view.frames[-1].labels("objects"), before)
    assert controls.state().corrections == "2 corrections"
    assert controls.state().found == "2 objects"
    assert said(controls, "undo") == ("undone: 1 objects", False)
    assert said(controls, "split 1 all") == ("split 2 from 1: 2 objects", False)
    controls.apply("undo")
    path = tmp_path / "labels-kitchen_day" / "small3_label.png"
    assert said(controls, "save") == (f"saved {path}", False)
    assert path.is_file()
    assert path.parent.stat().st_mode & 0o777 == 0o700
    assert controls.state().corrections == "1 correction, saved"
    assert "1 correction, saved" in controls.state().status
    assert said(controls, "undo")[1] is False
    assert view.frames[-1] is result
    assert said(controls, "undo") == ("undo: nothing was corrected", True)
    assert len(view.frames) == 6


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("merge 1", "merge: expected two or more objects to merge, got 1"),
        ("merge", "merge: expected two or more objects to merge, got none"),
        ("merge 1 two", "merge: expected the numbers of objects, got 'two'"),
        ("merge 1 7", "merge: no object 7 in this frame, but 1, 2"),
        ("split", "split: expected the numbers of objects, got ''"),
        ("split 1 2", "split: expected the number of an object, or with it all, got '1 2'"),
        ("split 1 all", "split: object 1 is one surface; it can only be split in two"),
        ("split 7", "split: no object 7 in this frame, but 1, 2"),
        ("split -1", "split: expected the numbers of objects, got '-1'"),
    ],
)
def test_what_cannot_be_corrected_is_said(
    controls: Controls, corrections: Corrections, view: Shown, command: str, why: str
) -> None:
    corrections.meet(small_result())
    controls.apply("pause")
    assert said(controls, command) == (why, True)
    assert view.frames == []
    assert controls.state().corrections == ""


def test_a_correction_waits_while_a_frame_is_segmented_and_other_commands_do_not(
    controls: Controls, corrections: Corrections, view: Shown
) -> None:
    corrections.meet(small_result())
    with controls.segmenting:
        controls.apply("pause", 1)
        assert (controls.state().paused, controls.state().answered) == (True, 1)
        thread = threading.Thread(target=controls.apply, args=("merge 1 2", 2))
        thread.start()
        thread.join(0.2)
        assert (controls.state().answered, view.frames) == (1, [])
    thread.join(30.0)
    assert (controls.state().answered, len(view.frames)) == (2, 1)
    # Those of a terminal have no number.
    controls.apply("undo")
    assert controls.state().answered == 2


@pytest.mark.parametrize("command", ["merge 1 2", "split 1", "undo", "save"])
def test_only_the_frame_of_a_pause_is_corrected(
    controls: Controls, corrections: Corrections, player: Player, command: str
) -> None:
    wait = f"{command.split()[0]}: pause first, and wait for the frame that is to be corrected"
    assert said(controls, command) == (wait, True)
    controls.apply("step")
    # It has not come yet.
    assert said(controls, command) == (wait, True)
    assert player.takes(player.read())
    assert said(controls, command) == (f"{command.split()[0]}: there is no frame yet", True)


@pytest.mark.parametrize(
    "command", ["resume", "pause", "step", "seek +1", "quit", "ratio 0.9", "level", "method"]
)
def test_unsaved_corrections_are_dropped_only_when_told_twice(
    controls: Controls, corrections: Corrections, player: Player, command: str
) -> None:
    corrections.meet(small_result())
    for each in ("pause", "merge 1 2"):
        controls.apply(each)
    name = command.split()[0]
    why = f"{name}: 1 correction not saved: save, or {name} once more to drop what was corrected"
    assert said(controls, command) == (why, True)
    assert player.paused
    assert not controls.ended
    assert controls.config == CONFIG
    controls.apply("snapshot")
    assert said(controls, command)[1] is False
    assert not player.waits or controls.ended or controls.config != CONFIG


def test_what_was_corrected_since_is_kept_again_and_what_is_saved_or_undone_is_not(
    controls: Controls, corrections: Corrections, player: Player
) -> None:
    corrections.meet(small_result())
    for each in ("pause", "merge 1 2"):
        controls.apply(each)
    assert said(controls, "step")[1]
    controls.apply("split 1")
    assert said(controls, "step")[1]
    controls.apply("save")
    assert not said(controls, "step")[1]
    corrections.meet(small_result(1))
    while not player.waits:
        assert player.takes(player.read())
    controls.apply("merge 1 2")
    controls.apply("undo")
    assert not said(controls, "step")[1]


def test_a_frame_that_is_shown_again_stays_corrected_and_another_is_not(
    controls: Controls, corrections: Corrections
) -> None:
    frame = small_frame()
    corrections.meet(process_frame(frame, CONFIG))
    for each in ("pause", "merge 1 2"):
        controls.apply(each)
    # For a snapshot, say.
    again = corrections.meet(process_frame(frame, CONFIG))
    assert np.unique(again.labels("objects")).tolist() == [0, 1]
    for other in (process_frame(small_frame(), CONFIG), small_result(0)):
        assert corrections.meet(other) is other
        assert controls.state().corrections == ""
        controls.apply("merge 1 2")
        assert controls.state().found == "1 objects"
    changed = process_frame(small_frame(), replace(CONFIG, ratio_max=0.9))
    changed = replace(changed, frame=other.frame)
    assert corrections.meet(changed) is changed
    assert controls.state().found == ""
    assert controls.state().corrections == ""


def test_labels_that_cannot_be_written_are_still_unsaved(
    controls: Controls, corrections: Corrections, tmp_path: Path
) -> None:
    corrections.meet(small_result())
    (tmp_path / "labels-kitchen_day").write_text("")
    for each in ("pause", "merge 1 2"):
        controls.apply(each)
    text, refused = said(controls, "save")
    assert refused
    assert text == f"save: {tmp_path / 'labels-kitchen_day'}: cannot be written: File exists"
    assert said(controls, "quit")[1]


def test_a_run_that_only_records_has_nothing_to_correct() -> None:
    with Player(NumberedSource(9)) as source:
        recording: Any = Controls(
            CONFIG, source, CaptureThread(source), Recorder(RecordConfig(), source), segments=False
        )
        assert said(recording, "merge 1 2")[1]
