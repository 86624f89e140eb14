"""Pixels that say how far a surface goes, in images whose edges are known."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes.borders import outline_pixels
from nurbseg.segmentation.points.registration import PointMap

NOISE = 2e-3
HEIGHT, WIDTH = 40, 60


def cloud_of(depth_m: NDArray[np.float64]) -> PointMap:
    points_m = np.zeros((*depth_m.shape, 3), dtype=np.float32)
    points_m[..., 2] = depth_m
    return PointMap(points_m, np.zeros((*depth_m.shape, 3), np.uint8), np.ones(depth_m.shape, dtype=bool))


def places(pixels: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.divmod(pixels, WIDTH)


def test_ends_of_rows_are_chosen_but_nothing_that_lies_behind_the_edge() -> None:
    depth_m = np.full((HEIGHT, WIDTH), 2.0)
    depth_m[10:30, 20:40] = 1.0
    # A column between both depths, and two of the background, have the label, too.
    depth_m[10:30, 40] = 1.5
    own = np.zeros(depth_m.shape, dtype=bool)
    own[10:30, 20:43] = True
    rows, columns = places(outline_pixels(np.flatnonzero(own), cloud_of(depth_m), NOISE, 7))
    left, right = rows[columns == 20], rows[columns == 39]
    assert set(left) | set(right) == set(range(10, 30))
    assert len(left) >= 10 and len(right) >= 10
    # One in seven, but for those beside the edge.
    steps = np.flatnonzero(own)[::7] % WIDTH
    assert np.count_nonzero(columns > 40) == np.count_nonzero(steps > 41)
    assert not (columns == 40).any()


def test_of_many_rows_both_ends_are_chosen_in_turn() -> None:
    own = np.zeros((400, WIDTH), dtype=bool)
    own[10:390, 20:40] = True
    chosen = outline_pixels(np.flatnonzero(own), cloud_of(np.ones(own.shape)), NOISE, 10_000)
    rows, columns = places(chosen[1:])
    assert 40 <= len(rows) <= 60
    assert set(columns) == {20, 39}
    assert np.abs(np.diff(rows)).max() < 10
    assert abs(np.count_nonzero(columns == 20) - np.count_nonzero(columns == 39)) <= 1


def test_a_surface_that_fills_the_image_ends_at_its_sides() -> None:
    chosen = outline_pixels(np.arange(HEIGHT * WIDTH), cloud_of(np.ones((HEIGHT, WIDTH))), NOISE, 10_000)
    rows, columns = places(chosen[1:])
    assert len(rows) > 20 and set(columns) == {0, WIDTH - 1}
    assert rows.max() - rows.min() > 0.9 * HEIGHT


def test_pixels_beside_edges_count_where_they_are_many() -> None:
    depth_m = np.full((HEIGHT, WIDTH), 2.0)
    depth_m[:, ::9] = 1.0
    column = np.arange(HEIGHT * WIDTH) % WIDTH
    rim = np.flatnonzero(np.isin(column % 9, (1, 8)))
    clear = np.flatnonzero(~np.isin(column % 9, (0, 1, 8)))
    mixed = rim[:100]
    for count, is_left_out in ((300, True), (299, False)):
        pixels = np.sort(np.concatenate([clear[:count], mixed]))
        chosen = outline_pixels(pixels, cloud_of(depth_m), NOISE, 1)
        assert np.isin(mixed, chosen).any() == (not is_left_out)
        assert np.isin(clear[:count], chosen).all()
