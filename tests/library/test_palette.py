from __future__ import annotations

import colorsys

import numpy as np
import pytest

from nurbseg.library.palette import (
    LABEL_COLORS,
    SHADES,
    STOP_COLORS,
    color_name,
    label_color,
    label_colors,
    residual_colors,
    shaded,
    shades_of_surfaces,
)
from nurbseg.segmentation.vocabulary import StopReason


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


@pytest.mark.parametrize("label", [1, 2, 17, 1024])
def test_shades_have_the_hue_of_their_object_and_differ(label: int) -> None:
    colors = [shaded(label, shade) for shade in range(SHADES)]
    assert colors[0] == label_color(label)
    hues = [colorsys.rgb_to_hsv(*(each / 255 for each in color))[0] for color in colors]
    # Rounding to whole numbers turns the hue of a pale shade by little.
    assert all(min(abs(hue - hues[0]), 1 - abs(hue - hues[0])) < 0.02 for hue in hues)
    luma = sorted(0.299 * red + 0.587 * green + 0.114 * blue for red, green, blue in colors)
    assert np.diff(luma).min() > 8


def test_an_objects_first_surface_has_its_color_and_the_others_further_shades() -> None:
    of = {5: 1, 2: 1, 3: 2, 9: 1, **dict.fromkeys(range(20, 30), 3)}
    shades = shades_of_surfaces(of)
    assert {each: shades[each] for each in (2, 3, 5, 9)} == {2: (1, 0), 3: (2, 0), 5: (1, 1), 9: (1, 2)}
    assert [shades[each] for each in range(20, 30)] == [(3, each % SHADES) for each in range(10)]


def test_colors_have_the_names_that_people_would_give_them() -> None:
    assert [color_name(each) for each in (1, 2, 3, 6)] == ["blue", "lime", "red", "magenta"]


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
    colors = residual_colors(np.array([0.0, 0.01, 0.02, 5.0]), 0.02).tolist()
    blue, green, red, beyond = np.array([[color >> shift & 255 for shift in (24, 16, 8)] for color in colors])
    assert blue[2] > 2 * max(blue[0], blue[1])
    assert green[1] > max(green[0], green[2])
    assert red[0] > 2 * max(red[1], red[2])
    assert (beyond == red).all()
