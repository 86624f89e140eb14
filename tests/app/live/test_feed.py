"""What the run is given of the captured frames."""

from __future__ import annotations

import logging
import signal
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scripted_source import small_frame

from nurbseg.app.control.commands import RunState
from nurbseg.app.live.feed import Feed, wait_for_quit
from nurbseg.app.live.interruption import Interruption
from nurbseg.app.settings.app_config import Control
from nurbseg.common.errors import EndOfRecordingError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.segmentation.config import SegmentationConfig


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> deque[str | None]:
    """Commands of the console, which are taken one by one; None where there is none yet."""
    waiting: deque[str | None] = deque()
    console = SimpleNamespace(take=waiting.popleft)
    monkeypatch.setattr("nurbseg.app.live.feed.open_console", lambda control: nullcontext(console))
    return waiting


class Given:
    """A source that gives frames; then none comes, or it ends."""

    def __init__(self, *frames: RGBDFrame, ends: bool = False) -> None:
        self.paused = False
        self._frames, self._ends = deque(frames), ends

    def read(self, timeout_s: float) -> RGBDFrame:
        if self._frames:
            return self._frames.popleft()
        raise EndOfRecordingError("the end") if self._ends else FrameTimeoutError("none")


def feed_of(source: Any, check: Callable[[], None] = lambda: None) -> Feed:
    progress: Any = SimpleNamespace(draw=lambda *_, **__: None, waiting=lambda: None)
    interruption: Any = SimpleNamespace(check=check)
    return Feed(source, progress, interruption)


def arrived(index: int, arrived_s: float, jumps: int = 0) -> RGBDFrame:
    return replace(small_frame(index), arrived_s=arrived_s, jumps=jumps)


def test_the_rate_of_the_source_is_that_of_its_frames_whatever_is_lost() -> None:
    # 12 frames/s; two of three are lost on the way, and once the camera is silent for three seconds.
    frames = [arrived(index, index / 12 + (3.0 if index > 30 else 0.0)) for index in range(0, 90, 3)]
    feed = feed_of(Given(*frames, ends=True))
    assert list(feed.frames()) == frames
    assert feed.source_hz == pytest.approx(12.0)


def test_a_jump_says_nothing_of_the_source_s_rate() -> None:
    frames = [arrived(index + 20 * (index // 2), index / 10, index // 2) for index in range(40)]
    feed = feed_of(Given(*frames, ends=True))
    assert len(list(feed.frames())) == 40
    assert feed.source_hz == pytest.approx(10.0)


def test_the_first_frame_without_any_depth_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    depth_mm = np.zeros((6, 8), np.uint16)
    empty = [replace(arrived(index, 0.0), depth_mm=depth_mm) for index in (3, 4)]
    list(feed_of(Given(*empty, ends=True)).frames())
    assert [message.split(";")[0] for message in caplog.messages] == ["frame 3: no pixel has depth"]


class NothingMoreError(Exception):
    """A run has looked for the next frame often enough."""


class ImpatientRun:
    """A run of one frame, after which nothing comes any more; raises after 20 looks."""

    def __init__(self, control: Control = "off") -> None:
        self.looks = 0
        self.applied: list[str] = []
        self.controls: Any = SimpleNamespace(
            config=SegmentationConfig(),
            ended=False,
            wanted=False,
            error=None,
            close=lambda: None,
            is_over=False,
            state=RunState,
            recorder=SimpleNamespace(log_finished=lambda: None),
            apply=self._apply,
        )
        self.source = Given(arrived(5, 0.0))
        progress: Any = SimpleNamespace(draw=lambda *_, **__: None, waiting=lambda: None)
        interruption: Any = SimpleNamespace(check=self._check)
        feed = Feed(self.source, progress, interruption)  # type: ignore[arg-type]
        self.frames = feed.controlled(control, self.controls)

    def _apply(self, command: str, number: int = 0) -> None:
        self.applied.append(f"{number} {command}" if number else command)

    def close(self) -> None:
        self.frames.close()

    def _check(self) -> None:
        self.looks += 1
        if self.looks > 20:
            raise NothingMoreError


def test_in_a_pause_the_last_frame_comes_again_once_for_each_change_of_the_settings() -> None:
    with closing(ImpatientRun()) as run:
        assert next(run.frames).index == 5
        run.source.paused = True
        for ratio in (0.5, 0.6):
            run.controls.config = replace(run.controls.config, ratio_max=ratio)
            before_s = time.monotonic()
            again = next(run.frames)
            # It is as new as the settings, or the time that it took would be that of the pause.
            assert (again.index, again.arrived_s >= before_s) == (5, True)
        with pytest.raises(NothingMoreError):
            next(run.frames)


def test_a_snapshot_that_was_asked_for_precedes_the_end() -> None:
    with closing(ImpatientRun()) as run:
        assert next(run.frames).index == 5
        run.controls.ended = run.controls.wanted = True
        assert next(run.frames).index == 5
        run.controls.wanted = False
        assert list(run.frames) == []


def test_all_commands_that_wait_are_executed_before_a_frame(typed: deque[str | None]) -> None:
    typed.extend(["ratio 0.9", "level things", None, "quit"])
    with closing(ImpatientRun()) as run:
        assert next(run.frames).index == 5
        assert run.applied == ["ratio 0.9", "level things"]
        assert list(typed) == ["quit"]


def test_a_command_of_another_thread_that_fails_ends_the_run() -> None:
    with closing(ImpatientRun()) as run:
        assert next(run.frames).index == 5
        run.controls.error = RuntimeError("no command")
        with pytest.raises(RuntimeError, match="no command"):
            next(run.frames)


def test_after_the_last_frame_only_the_command_to_quit_has_an_effect(
    typed: deque[str | None], caplog: pytest.LogCaptureFixture
) -> None:
    typed.extend(["pause", None, "quit", "seek 3"])
    with caplog.at_level(logging.INFO, "nurbseg.app.live.feed"):
        wait_for_quit("lines", Interruption())
    assert list(typed) == ["seek 3"]
    assert caplog.messages == ["all frames are shown; q or Ctrl-C ends the server"]


def test_without_a_console_a_signal_ends_the_server(caplog: pytest.LogCaptureFixture) -> None:
    interruption = Interruption()
    interruption.signal_number = signal.SIGTERM
    with caplog.at_level(logging.INFO, "nurbseg.app.live.feed"), pytest.raises(KeyboardInterrupt):
        wait_for_quit("off", interruption)
    assert caplog.messages == ["all frames are shown; Ctrl-C ends the server"]
