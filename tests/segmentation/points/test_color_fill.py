import numpy as np

from nurbseg.segmentation.points.color_fill import fill_colors

RED, BLUE, GREEN = (255, 0, 0), (0, 0, 255), (0, 255, 0)
SIZE = (20, 30)


def filled(color, known, depth_m):
    image = np.array(color, dtype=np.uint8)
    fill_colors(image, known, ~known, depth_m.astype(np.float32), 0.05)
    return image


def everywhere(color):
    return np.full((*SIZE, 3), color, dtype=np.uint8)


def test_a_hole_is_filled_from_its_own_surface_not_from_a_nearer_one():
    color, known, depth = everywhere(BLUE), np.ones(SIZE, bool), np.full(SIZE, 2.0)
    color[:, :10], depth[:, :10] = RED, 1.0
    known[5:15, 10:14] = False
    color[~known] = 0
    image = filled(color, known, depth)
    assert (image[~known] == BLUE).all()
    assert np.array_equal(image[known], color[known])


def test_a_surface_at_the_same_depth_is_taken_before_a_farther_one_that_is_closer_by():
    color, known, depth = everywhere(GREEN), np.ones(SIZE, bool), np.full(SIZE, 3.0)
    color[:, :15], depth[:, :15] = BLUE, 2.0
    known[8:12, 10:15] = False
    image = filled(color, known, depth)
    assert (image[~known] == BLUE).all()


def test_the_nearest_source_counts_on_either_side():
    depth = np.full(SIZE, 2.0)
    # Sources begin two pixels beside a hole; strips of two pixels between holes are the last resort.
    for axis, first, end in ((0, 0, 20), (1, 0, 30), (0, 3, 17), (1, 3, 17)):
        place = np.indices(SIZE)[axis]
        color = everywhere(RED)
        known = ((place >= first) & (place < 5)) | ((place >= 15) & (place < end))
        color[place >= 10] = BLUE
        image = filled(np.where(known[..., np.newaxis], color, 0), known, depth)
        assert np.array_equal(image, color)


def test_corners_without_a_known_pixel_in_their_row_or_column_are_filled():
    color, known, depth = everywhere(0), np.zeros(SIZE, bool), np.full(SIZE, 2.0)
    known[8:12, 12:18] = True
    color[known] = BLUE
    assert (filled(color, known, depth) == BLUE).all()


def test_what_is_enclosed_by_nearer_things_takes_what_lies_behind_elsewhere():
    color, known, depth = everywhere(RED), np.ones(SIZE, bool), np.full(SIZE, 1.0)
    color[:, 25:], depth[:, 25:] = GREEN, 4.0
    color[:3, :3], depth[:3, :3] = BLUE, 2.0
    hole = (slice(8, 12), slice(8, 12))
    known[hole], depth[hole] = False, 2.0
    depth[8:12, 25:], color[8:12, 25:] = 1.0, RED
    assert (filled(color, known, depth)[hole] == BLUE).all()


def test_where_everything_known_is_nearer_the_farthest_of_it_serves():
    color, known, depth = everywhere(RED), np.ones(SIZE, bool), np.full(SIZE, 1.0)
    color[0, 0], depth[0, 0] = GREEN, 1.5
    hole = (slice(8, 12), slice(8, 12))
    known[hole], depth[hole] = False, 3.0
    assert (filled(color, known, depth)[hole] == GREEN).all()


def test_single_known_pixels_are_sources_even_next_to_missing_ones():
    known = np.zeros(SIZE, bool)
    known[10, 10] = True
    color = everywhere(0)
    color[10, 10] = GREEN
    assert (filled(color, known, np.full(SIZE, 2.0)) == GREEN).all()


def test_nothing_known_changes_nothing():
    color = everywhere(7)
    assert (filled(color, np.zeros(SIZE, bool), np.full(SIZE, 2.0)) == 7).all()
