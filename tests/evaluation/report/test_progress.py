"""How far a command is."""

from __future__ import annotations

import sys

import pytest
from fake_clock import FakeClock

from nurbseg.evaluation.report.progress import Progress


def test_a_log_gets_a_line_a_minute_and_the_last(capsys: pytest.CaptureFixture[str]) -> None:
    clock = FakeClock()
    progress = Progress("frames", clock)
    # Ten were there before; each other takes 25 s.
    for done in range(10, 31):
        progress(done, 30)
        clock.now_s += 25.0
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "13/30 frames, 7 min left",
        "16/30 frames, 6 min left",
        "19/30 frames, 5 min left",
        "22/30 frames, 3 min left",
        "25/30 frames, 2 min left",
        "28/30 frames, 50 s left",
        "30/30 frames",
    ]


def test_a_terminal_gets_one_line_that_grows(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    clock = FakeClock()
    progress = Progress("settings", clock)
    progress(0, 2)
    clock.now_s += 7200.0
    progress(1, 2, "best 0.9")
    progress(2, 2)
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1 and shown.endswith("\n")
    first, second, last = shown.split("\r")[1:]
    assert first.startswith(f"[{'.' * 30}] 0/2 settings")
    assert second.startswith(f"[{'#' * 15}{'.' * 15}] 1/2 settings, 2.0 h left best 0.9")
    assert last.startswith(f"[{'#' * 30}] 2/2 settings ")
