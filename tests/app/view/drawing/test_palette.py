from __future__ import annotations

import numpy as np

from nurbseg.app.view.drawing.palette import LABEL_COLORS, STOP_COLORS, label_colors, residual_colors
from nurbseg.segmentation.segments import StopReason


def test_every_label_has_a_color_of_its_own() -> None:
    colors = label_colors()
    assert colors.shape == (LABEL_COLORS, 3)
    assert len(np.unique(colors, axis=0)) == LABEL_COLORS


def test_the_first_colors_differ_clearly() -> None:
    colors = label_colors()[:24].astype(int)
    distance = np.abs(colors[:, np.newaxis] - colors).sum(axis=-1) + 1000 * np.eye(24, dtype=int)
    assert distance.min() > 50


def test_no_label_is_as_dark_as_the_background() -> None:
    assert label_colors().max(axis=1).min() > 100


def test_every_stop_reason_has_a_color_and_the_papers_are_as_in_figure_3() -> None:
    assert set(STOP_COLORS) == set(StopReason)
    assert len(set(STOP_COLORS.values())) == len(StopReason)
    red, green, blue = STOP_COLORS[StopReason.CRITERION]
    assert red > 2 * max(green, blue)
    red, green, blue = STOP_COLORS[StopReason.CHILD_TOO_SMALL]
    assert red > green > blue
    for reason in (StopReason.TOO_SMALL, StopReason.DEPTH):
        red, green, blue = STOP_COLORS[reason]
        assert green > max(red, blue)
    assert sum(STOP_COLORS[StopReason.TOO_SMALL]) > sum(STOP_COLORS[StopReason.DEPTH])


def test_residuals_run_from_blue_over_green_to_red_and_stay_red() -> None:
    blue, green, red, beyond = residual_colors(np.array([0.0, 0.01, 0.02, 5.0]), 0.02).astype(int)
    assert blue[2] > 2 * max(blue[0], blue[1])
    assert green[1] > max(green[0], green[2])
    assert red[0] > 2 * max(red[1], red[2])
    assert (beyond == red).all()
