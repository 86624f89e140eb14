"""The rate controller does less while frames take too long, more when there is time, and says so."""

import logging
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from nurbseg.library.rate_controller import RateController
from nurbseg.segmentation.live.tree import UNLIMITED, Budget

#: Times of frames, milliseconds, of which a period is 33, and whether less is done after them.
TIMES = {
    "the rate holds": ([25.0] * 200, False),
    "a single slow frame": ([20.0] * 50 + [60.0] + [20.0] * 49, False),
    "slow first frames": ([80.0 / (1 + frame) + 20.0 for frame in range(100)], False),
    "a rich scene for a second": ([25.0] * 100 + [32.0] * 40 + [25.0] * 190, False),
    "a rich scene that stays": ([25.0] * 300 + [32.0] * 101, True),
    "a second in which the rate does not hold": ([25.0] * 100 + [35.0] * 40, True),
}


@pytest.mark.parametrize(("times_ms", "less"), TIMES.values(), ids=TIMES)
def test_less_is_done_where_the_rate_does_not_hold_for_a_while(
    caplog: pytest.LogCaptureFixture, times_ms: list[float], less: bool
) -> None:
    caplog.set_level(logging.INFO, logger="nurbseg")
    controller = RateController(30.0)
    for time_ms in times_ms:
        controller.took(time_ms)
    assert (controller.level > 0) == bool(caplog.messages) == less
    assert controller.budget() == Budget(coarser=controller.level)


def test_less_is_done_step_by_step_until_the_rate_holds(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="nurbseg")
    controller = RateController(30.0)
    budgets = []
    for _ in range(200):
        # Half of the time goes with the places of the grid.
        budget = controller.budget()
        budgets.append(budget)
        controller.took(20.0 + 25.0 * (2 / (2 + budget.coarser)) ** 2)
    steps = [2 + budget.coarser for budget in budgets]
    assert steps == sorted(steps)
    assert steps[0] == 2 < steps[-1]
    assert 20.0 + 25.0 * (2 / steps[-1]) ** 2 < 1000 / 30
    # What is to be revised is revised: otherwise the frame is segmented from scratch before long.
    assert {replace(budget, coarser=0) for budget in budgets} == {Budget()}
    assert all("doing less to hold 30 frames/s" in message for message in caplog.messages)
    assert len(caplog.messages) == controller.level


def test_less_of_a_late_frame_is_updated_but_never_nothing() -> None:
    controller, usual = RateController(30.0), Budget()
    assert controller.budget(1.0) == usual
    late = [controller.budget(20.0) for _ in range(20)]
    assert all(1 <= each.trials < usual.trials for each in late)
    assert all(0 < each.judged_pixels < usual.judged_pixels for each in late)
    assert controller.budget(1.0) == usual


@pytest.mark.parametrize("given", [Budget(trials=1), UNLIMITED])
def test_a_frame_in_time_has_the_budget_that_was_given(given: Budget) -> None:
    controller = RateController(30.0, given)
    assert controller.budget() == given
    assert 1 <= controller.budget(20.0).trials <= min(given.trials, 3)
    for _ in range(30):
        controller.took(100.0)
    coarser = controller.budget()
    assert coarser.coarser > 0
    assert replace(coarser, coarser=0) == given


def test_first_frames_far_too_slow_are_reason_enough() -> None:
    controller, levels = RateController(60.0), []
    for _ in range(10):
        controller.took(23.0)
        levels.append(controller.level)
    assert levels == [0] * 7 + [1] * 3


def test_a_computer_that_is_slow_for_a_while_does_less_for_as_long() -> None:
    controller = RateController(30.0)
    levels = []
    for frame in range(1200):
        factor = 1.5 if 200 <= frame < 600 else 1.0
        controller.took(factor * (14.0 + 12.0 * (2 / (2 + controller.budget().coarser)) ** 2))
        levels.append(controller.level)
    assert set(levels[:200]) == {0}
    assert min(levels[230:600]) > 0
    assert sum(a != b for a, b in pairwise(levels[230:600])) <= 6
    assert set(levels[1000:]) == {0}


def test_frames_segmented_from_scratch_do_not_change_the_rate() -> None:
    controller = RateController(30.0)
    for _ in range(100):
        controller.took(500.0, cold=True)
    assert controller.level == 0


def test_more_is_done_again_when_there_is_time_but_not_over_and_over() -> None:
    controller = RateController(30.0)
    for _ in range(30):
        controller.took(100.0)
    assert controller.level > 0
    for _ in range(10_000):
        controller.took(5.0)
    assert controller.level == 0

    # A step that costs too much is not tried again while that is remembered.
    levels = []
    for _ in range(8000):
        controller.took(40.0 if controller.level == 0 else 15.0)
        levels.append(controller.level)
    tries = sum(a == 1 and b == 0 for a, b in pairwise(levels))
    assert 1 <= tries <= 2


def test_it_holds_no_more_than_the_rate_of_the_source() -> None:
    # 40 ms are too much for 30 frames/s, and leave half of the time of 12 frames/s.
    controller = RateController(30.0)
    for _ in range(2000):
        controller.took(40.0, source_hz=12.0)
    assert controller.level == 0
    for _ in range(100):
        controller.took(40.0, source_hz=60.0)
    assert controller.level > 0


@pytest.mark.parametrize("costs_ms", [(40, 24, 18), (30, 24, 21), (33, 26, 22), (27, 20, 17)])
def test_costs_near_the_limit_make_it_change_seldom(costs_ms: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    controller, levels = RateController(30.0), []
    for _ in range(4500):  # two and a half minutes
        controller.took(costs_ms[controller.level] * rng.uniform(0.8, 1.3))
        levels.append(controller.level)
    assert sum(a != b for a, b in pairwise(levels)) <= 7


def test_a_rate_is_more_than_0() -> None:
    with pytest.raises(ValueError, match="target_hz"):
        RateController(0.0)
