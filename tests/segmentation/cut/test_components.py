import numpy as np

from nurbseg.segmentation.cut.components import give_away_small_pieces


def picture(*rows: str):
    """Mask and side from characters: 0 and 1 are sides, a dot is outside."""
    letters = np.array([list(row) for row in rows])
    return letters != ".", letters == "1"


def test_small_pieces_of_either_side_go_to_the_other():
    mask, side = picture("0000111", "0100101", "0000111", "0000111")
    expected = picture("0000111", "0000111", "0000111", "0000111")[1]
    assert (give_away_small_pieces(mask, side, 2) == expected).all()


def test_pieces_of_the_limit_stay():
    mask, side = picture("00000", "01100", "00000")
    assert (give_away_small_pieces(mask, side, 2) == side).all()
    assert not give_away_small_pieces(mask, side, 3).any()


def test_pixels_that_touch_at_a_corner_are_one_piece():
    mask, side = picture("00000", "01000", "00100", "00000")
    assert (give_away_small_pieces(mask, side, 2) == side).all()


def test_an_island_stays_what_it_is():
    mask, side = picture("000.1", "000..", "000.0", "111..", "111..")
    assert (give_away_small_pieces(mask, side, 3) == side).all()


def test_specks_of_both_sides_do_not_change_places():
    # A single 1 within a piece of two 0 within 1: the 1 joins the 0 and then stays there.
    mask, side = picture("111111", "100001", "101001", "100001", "111111")
    cleaned = give_away_small_pieces(mask, side, 3)
    assert not cleaned[2, 2]
    assert (cleaned[0] == 1).all()


def test_outside_of_the_mask_there_is_no_side():
    mask, side = picture("0011", "..11")
    side[1, 0] = True
    assert not give_away_small_pieces(mask, side, 1)[1, 0]


def test_no_points_have_no_pieces():
    mask, side = picture("....", "....")
    assert not give_away_small_pieces(mask, side, 5).any()
