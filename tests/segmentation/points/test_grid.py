"""The step of the grid on which splits are decided."""

import numpy as np
import pytest

from nurbseg.segmentation.points.grid import grid_step


@pytest.mark.parametrize(
    ("width", "decimation", "step"),
    [(320, 0, 1), (321, 0, 2), (640, 0, 2), (1280, 0, 2), (320, 2, 2), (320, 3, 3), (640, 1, 1)],
)
def test_a_step_that_is_set_is_kept_and_else_small_images_keep_every_pixel(width, decimation, step):
    assert grid_step(np.ones((6, width), dtype=bool), decimation) == step


def test_a_grid_holds_a_point_where_the_image_does():
    valid = np.zeros((6, 640), dtype=bool)
    assert grid_step(valid, 3) == 3
    valid[1, 4] = True
    assert grid_step(valid, 3) == grid_step(valid, 0) == 1
    valid[2, 4] = True
    assert (grid_step(valid, 3), grid_step(valid, 0)) == (1, 2)
