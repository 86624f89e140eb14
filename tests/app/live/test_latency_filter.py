"""What is too old is not shown, and a slow computer shows something all the same."""

import logging

import pytest
from fake_clock import FakeClock

from nurbseg.app.view.view import LatencyFilter


def test_what_is_older_than_allowed_is_held_back_and_counted() -> None:
    clock = FakeClock()
    latency_filter = LatencyFilter(100.0, clock=clock)
    passed = []
    for age_ms in (30.0, 100.0, 100.1, 400.0, 60.0):
        passed.append(latency_filter.passes(age_ms))
        clock.now_s += 0.1
    assert passed == [True, True, False, False, True]
    assert latency_filter.held_back == 2


def test_the_first_is_shown_however_old() -> None:
    assert LatencyFilter(100.0, clock=FakeClock()).passes(3000.0)


def test_a_slow_computer_shows_one_frame_a_second_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    clock = FakeClock()
    latency_filter = LatencyFilter(100.0, clock=clock)
    shown_s = []
    with caplog.at_level(logging.WARNING):
        for _ in range(50):
            if latency_filter.passes(250.0):
                shown_s.append(clock.now_s)
            clock.now_s += 0.25
    assert len(shown_s) == 13
    assert latency_filter.held_back == 37
    assert [record.getMessage() for record in caplog.records] == [
        "labels come 250 ms after their frame; of those over 100 ms only one per second is shown"
    ]


def test_with_a_limit_of_0_nothing_is_too_old() -> None:
    latency_filter = LatencyFilter(0.0, clock=FakeClock())
    assert all(latency_filter.passes(1e6) for _ in range(10))
    assert latency_filter.held_back == 0
