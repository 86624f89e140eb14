"""Labels of color's pixels, on the depth pixels that show the same."""

from pathlib import Path

import numpy as np
import pytest
from recorded_scene import scenes, write_image

from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers import SourceOptions, open_source

DEPTH = Intrinsics(64, 48, 57.6, 57.6, 31.5, 23.1)
COLOR = Intrinsics(130, 97, 116.0, 116.2, 64.0, 48.0)


@pytest.mark.parametrize("shift_m", [0.0, 0.06])
def test_labels_of_color_are_those_of_the_depth_pixels_that_show_the_same(
    tmp_path: Path, shift_m: float
) -> None:
    step = np.eye(4)
    step[0, 3] = shift_m
    apart = Calibration(DEPTH, COLOR, step)
    labels = np.full((97, 130), 3, np.uint16)
    labels[20:60, 40:90] = 5001
    for index, frame in enumerate(scenes(2, apart)):
        write_image(tmp_path / "color" / f"{index}.jpg", frame.color)
        write_image(tmp_path / "depth" / f"{index}.png", frame.depth_mm)
        write_image(tmp_path / "label" / f"{index}.png", labels)
    with open_source(tmp_path, SourceOptions(calibration=apart)) as source:
        for frame in source:
            expected = np.zeros((48, 64), np.uint16)
            for v, u in np.argwhere(frame.depth_mm > 0):
                z = frame.depth_mm[v, u] / 1000
                x, y = (u - DEPTH.cx) / DEPTH.fx * z + shift_m, (v - DEPTH.cy) / DEPTH.fy * z
                column, row = round(x / z * COLOR.fx + COLOR.cx), round(y / z * COLOR.fy + COLOR.cy)
                if 0 <= column < 130 and 0 <= row < 97:
                    expected[v, u] = labels[row, column]
            np.testing.assert_array_equal(frame.labels, expected)
            assert set(np.unique(frame.labels)) == {0, 3, 5001}
