"""The governor does less while frames take too long, more when there is time, and says so."""

import logging
from itertools import pairwise

import pytest

from nurbseg.app.governor import Governor
from nurbseg.segmentation.live import Budget


def test_nothing_is_given_up_while_the_rate_holds(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    governor = Governor(30.0, 2)
    for _ in range(200):
        governor.took(25.0)
    assert governor.level == 0
    assert governor.budget == Budget(decimation=2)
    assert not caplog.messages


def test_less_is_done_step_by_step_until_the_rate_holds(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    governor = Governor(30.0, 2)
    budgets = []
    for _ in range(200):
        # Half of the time goes with the places of the grid, and a millisecond with each refit.
        budget = governor.budget
        assert budget.decimation is not None
        budgets.append(budget)
        governor.took(15.0 + 20.0 * (2 / budget.decimation) ** 2 + budget.refits)
    steps = [budget.decimation for budget in budgets]
    assert steps == sorted(steps)
    assert steps[0] == 2 < steps[-1]
    assert 15.0 + 20.0 * (2 / steps[-1]) ** 2 + budgets[-1].refits < 1000 / 30
    assert all("doing less to hold 30 frames/s" in message for message in caplog.messages)
    assert len(caplog.messages) == governor.level


def test_a_single_slow_frame_changes_nothing() -> None:
    governor = Governor(30.0, 2)
    for frame in range(100):
        governor.took(60.0 if frame == 50 else 20.0)
    assert governor.level == 0


def test_frames_segmented_anew_tell_nothing() -> None:
    governor = Governor(30.0, 2)
    for _ in range(100):
        governor.took(500.0, cold=True)
    assert governor.level == 0


def test_more_is_done_again_when_there_is_time_but_not_over_and_over() -> None:
    governor = Governor(30.0, 2)
    for _ in range(30):
        governor.took(100.0)
    assert governor.level > 0
    for _ in range(10_000):
        governor.took(5.0)
    assert governor.level == 0

    # A step that is too much each time it is tried is tried less and less often.
    levels = []
    for _ in range(3000):
        governor.took(40.0 if governor.level == 0 else 15.0)
        levels.append(governor.level)
    tries = sum(a == 1 and b == 0 for a, b in pairwise(levels))
    assert 1 <= tries < 3000 / 70 / 2


def test_a_rate_is_more_than_0() -> None:
    with pytest.raises(ValueError, match="target_hz"):
        Governor(0.0, 2)
