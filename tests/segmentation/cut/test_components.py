import numpy as np
import pytest
from scipy import ndimage

from nurbseg.segmentation.cut.components import remove_small_components


@pytest.mark.parametrize("seed", range(12))
def test_pieces_are_those_that_scipy_finds(seed):
    rng = np.random.default_rng(seed)
    blurred = ndimage.gaussian_filter(rng.standard_normal((13, 17)), 0.3 + 0.1 * seed)
    # In every third many pieces touch nothing of the other side.
    mask, side = rng.random((13, 17)) < (0.8, 0.8, 0.3)[seed % 3], blurred > np.quantile(blurred, 0.4)
    pixels_min = 1 + seed % 6
    expected = side & mask
    for value in (True, False):
        pieces, count = ndimage.label(mask & (expected == value), np.ones((3, 3)))
        other = mask & (expected != value)
        for piece in range(1, count + 1):
            own = pieces == piece
            if own.sum() < pixels_min and (ndimage.binary_dilation(own, np.ones((3, 3))) & other).any():
                expected[own] = not value
    assert (remove_small_components(mask, side, pixels_min) == expected).all()


@pytest.mark.parametrize("direction", [d for d in np.ndindex(3, 3) if d != (1, 1)])
def test_a_piece_may_touch_the_other_side_in_any_direction(direction):
    # The other side is at an edge or a corner of the image.
    mask, side = np.zeros((3, 3), dtype=bool), np.zeros((3, 3), dtype=bool)
    mask[1, 1] = mask[direction] = side[1, 1] = True
    assert not remove_small_components(mask, side, 2).any()
