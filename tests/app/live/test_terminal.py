"""The status line: what reaches the terminal, and when there is one at all."""

from __future__ import annotations

import io
import logging
import os
import sys
from collections.abc import Iterator

import pytest

from nurbseg.app.live import progress
from nurbseg.app.live.feed import open_status_line
from nurbseg.app.live.progress import StatusLine, cut
from nurbseg.app.settings.app_config import Control


class FakeTerminal(io.StringIO):
    """Text that is written to what says it is a terminal."""

    def fileno(self) -> int:
        return 2

    def isatty(self) -> bool:
        return True


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> FakeTerminal:
    monkeypatch.setattr(progress, "in_foreground", lambda descriptor: True)
    monkeypatch.setattr(os, "get_terminal_size", lambda descriptor: os.terminal_size((20, 24)))
    return FakeTerminal()


@pytest.fixture
def log(written: FakeTerminal) -> Iterator[logging.Logger]:
    handler = logging.StreamHandler(written)
    logging.getLogger().addHandler(handler)
    yield logging.getLogger("nurbseg.status")
    logging.getLogger().removeHandler(handler)


def test_lines_of_the_log_take_the_place_of_the_status_which_is_drawn_again(
    written: FakeTerminal, log: logging.Logger
) -> None:
    with StatusLine(written) as line:
        log.warning("first")
        line.show("status 1")
        log.warning("two\nlines")
        line.show("status 2")
    log.warning("last")
    assert all(getattr(handler, "stream", None) is not line for handler in logging.getLogger().handlers)
    erase = "\r\x1b[K"
    assert written.getvalue() == (
        f"first\nstatus 1\r{erase}two\nlines\nstatus 1\r{erase}status 2\r{erase}last\n"
    )


def test_the_status_is_cut_and_not_wrapped(written: FakeTerminal) -> None:
    StatusLine(written).show("123456789 123456789 123456789")
    assert written.getvalue() == "123456789 123456789\r"


@pytest.mark.parametrize(
    ("text", "columns", "expected"),
    [
        ("abc", 3, "abc"),
        ("abc", 2, "ab"),
        ("漢字漢字", 5, "漢字"),
        ("e\u0301te\u0301", 2, "e\u0301t"),
        ("a\x1b[2Jb\n", 9, "a?[2Jb?"),
    ],
)
def test_a_text_has_the_width_that_a_terminal_gives_it(text: str, columns: int, expected: str) -> None:
    assert cut(text, columns) == expected


def test_a_program_in_the_background_leaves_the_terminal_to_others(
    written: FakeTerminal, log: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    with StatusLine(written) as line:
        line.show("status")
        monkeypatch.setattr(progress, "in_foreground", lambda descriptor: False)
        line.show("status")
        log.warning("first")
        monkeypatch.setattr(progress, "in_foreground", lambda descriptor: True)
        line.show("again")
    assert written.getvalue() == "status\rfirst\nagain\r\r\x1b[K"


@pytest.mark.parametrize(
    ("control", "level", "kind", "expected"),
    [
        ("auto", logging.INFO, "xterm", True),
        ("off", logging.INFO, "xterm", False),
        ("lines", logging.INFO, "xterm", False),
        ("auto", logging.WARNING, "xterm", False),
        ("auto", logging.INFO, "dumb", False),
    ],
)
def test_a_status_line_is_for_somebody_at_a_terminal_who_wants_to_know(
    control: Control, level: int, kind: str, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", FakeTerminal())
    monkeypatch.setattr(sys, "stderr", FakeTerminal())
    monkeypatch.setenv("TERM", kind)
    logger = logging.getLogger("nurbseg")
    before = logger.level
    logger.setLevel(level)
    try:
        with open_status_line(control) as line:
            assert (line is not None) == expected
    finally:
        logger.setLevel(before)
