import numpy as np
import pytest
from scipy import ndimage

from nurbseg.segmentation.cut.components import remove_small_components


def picture(*rows: str):
    """Mask and side from characters: 0 and 1 are sides, a dot is outside."""
    letters = np.array([list(row) for row in rows])
    return letters != ".", letters == "1"


def test_small_pieces_of_either_side_go_to_the_other():
    mask, side = picture("0000111", "0100101", "0000111", "0000111")
    expected = picture("0000111", "0000111", "0000111", "0000111")[1]
    assert (remove_small_components(mask, side, 2) == expected).all()


def test_pieces_of_the_limit_stay():
    mask, side = picture("00000", "01100", "00000")
    assert (remove_small_components(mask, side, 2) == side).all()
    assert not remove_small_components(mask, side, 3).any()


def test_pixels_that_touch_at_a_corner_are_one_piece():
    mask, side = picture("00000", "01000", "00100", "00000")
    assert (remove_small_components(mask, side, 2) == side).all()


def test_an_island_stays_what_it_is():
    mask, side = picture("000.1", "000..", "000.0", "111..", "111..")
    assert (remove_small_components(mask, side, 3) == side).all()


def test_specks_of_both_sides_do_not_change_places():
    # A single 1 within a piece of two 0 within 1: the 1 joins the 0 and then stays there.
    mask, side = picture("111111", "100001", "101001", "100001", "111111")
    cleaned = remove_small_components(mask, side, 3)
    assert not cleaned[2, 2]
    assert (cleaned[0] == 1).all()


def test_outside_of_the_mask_there_is_no_side():
    mask, side = picture("0011", "..11")
    side[1, 0] = True
    assert not remove_small_components(mask, side, 1)[1, 0]


def test_no_points_have_no_pieces():
    mask, side = picture("....", "....")
    assert not remove_small_components(mask, side, 5).any()


@pytest.mark.parametrize("seed", range(12))
def test_pieces_are_those_that_scipy_finds(seed):
    rng = np.random.default_rng(seed)
    blurred = ndimage.gaussian_filter(rng.standard_normal((13, 17)), 0.3 + 0.1 * seed)
    mask, side = rng.random((13, 17)) < 0.8, blurred > np.quantile(blurred, 0.4)
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
