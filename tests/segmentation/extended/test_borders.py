import numpy as np
import pytest
from fitted import fits_of
from inverse_depth_lattice import inverse_depth_lattice

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.borders import refine_borders
from nurbseg.segmentation.points.grid import depth_grid, inverse_depth_image
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

CONFIG = SegmentationConfig()


def fitted(cloud, truth):
    return [fit.surface for fit in fits_of(depth_grid(cloud, 1), truth, CONFIG)]


def ragged(truth, most):
    """Labels of places up to so many pixels away."""
    shift = np.random.default_rng(0).integers(-most, most + 1, (2, *truth.shape))
    places = np.indices(truth.shape) + shift
    rows, columns = (each.clip(0, size - 1) for each, size in zip(places, truth.shape, strict=True))
    return truth[rows, columns].astype(np.int32)


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_ragged_borders_return_to_where_the_surfaces_meet(cloud_of, box_on_table, noise, step):
    depth, truth = box_on_table(noise_per_m=noise)
    cloud = cloud_of(depth)
    surfaces, images = fitted(cloud, truth), (ragged(truth, 3), truth, inverse_depth_image(cloud))
    labels, truth, inverse_depth = (each[::step, ::step] for each in images)
    refined = refine_borders(
        labels, inverse_depth, SurfaceTable(surfaces), CONFIG, rms_per_m=[0.0] * len(surfaces), step=step
    )
    assert (labels != truth).mean() > 0.01
    assert (refined != truth).mean() < 0.25 * (labels != truth).mean()
    assert ((refined > 0) == (truth > 0)).all()


def swept(labels, inverse_depth, explained, deviations, config, sweeps=4):
    """Labels moved to the cheapest around them, one pixel after the other, as plainly as can be."""
    labels, (height, width) = labels.copy(), labels.shape

    def around(r, c):
        for other in ((a, b) for a in range(r - 2, r + 3) for b in range(c - 2, c + 3)):
            if 0 <= other[0] < height and 0 <= other[1] < width and labels[other] > 0:
                yield other

    pixels = list(zip(*np.nonzero(labels), strict=True))
    for sweep in range(sweeps):
        best = {}
        for r, c in pixels if sweep < 2 else [pixel for pixel in pixels if (sum(pixel) + sweep) % 2 == 0]:
            cost = {}
            for label in {labels[other] for other in around(r, c)}:
                deviation = deviations[label - 1]
                residual = (explained[label - 1][r, c] - inverse_depth[r, c]) / deviation
                cost[label] = min(residual**2, 16) + 2 * np.log(
                    deviation / config.extended.inverse_depth_noise
                )
            for other in around(r, c):
                apart = np.hypot(other[0] - r, other[1] - c)
                if apart > 0:
                    is_gap = abs(
                        inverse_depth[other] - inverse_depth[r, c]
                    ) >= config.extended.inverse_depth_gap * np.sqrt(apart)
                    cost[labels[other]] -= (0.25 if is_gap else 1.0) * 0.7 / apart
            cheapest = min(cost, key=lambda label: (cost[label], label))
            if cheapest != labels[r, c]:
                best[r, c] = cheapest
        for place, label in best.items():
            labels[place] = label
        pixels = sorted({other for place in best for other in around(*place)})
    return labels


def test_sweeps_are_those_over_one_pixel_after_the_other(cloud_of, box_on_table):
    depth, truth = box_on_table(noise_per_m=2e-3)
    surfaces, inverse_depth = fitted(cloud_of(depth), truth), inverse_depth_image(cloud_of(depth)).copy()
    # Flying pixels, which no surface explains.
    inverse_depth[np.random.default_rng(1).random(truth.shape) < 0.1] += np.float32(0.03)
    explained = [
        inverse_depth_lattice(surface, np.arange(320.0), np.arange(240.0))[0] for surface in surfaces
    ]
    # One surface is better than noise, the others are worse.
    rms_per_m = [1e-3, *np.linspace(3e-3, 5e-3, len(surfaces) - 1)]
    # Two parts of the box; no piece is too small.
    config = updated(CONFIG, extended={"piece_pixels_min": 1})
    for top, left in ((70, 90), (110, 170)):
        window = slice(top, top + 60), slice(left, left + 80)
        labels = np.zeros_like(truth)
        labels[window] = ragged(truth, 2)[window]
        refined = refine_borders(labels, inverse_depth, SurfaceTable(surfaces), config, rms_per_m=rms_per_m)
        there = [each[window] for each in explained]
        deviations = [config.extended.inverse_depth_noise, *rms_per_m[1:]]
        expected = swept(labels[window], inverse_depth[window], there, deviations, config)
        assert (refined[window] == expected).all()
        assert (refined != labels).any()


def test_of_labels_that_cost_the_same_the_smallest_is_taken():
    labels = np.zeros((9, 8), np.int32)
    # One vote for each of two others, one for another and the own one; and, out of reach, one pixel of each.
    labels[0, :3], labels[4, :3], labels[8, ::3] = (1, 3, 2), (1, 2, 2), (1, 2, 3)
    depths, none = (labels > 0).astype(np.float32), SurfaceTable([None] * 3)
    options = {"rms_per_m": [0.0] * 3, "sweeps": 1, "spread_severed": False}
    refined = refine_borders(labels, depths, none, CONFIG, **options)
    assert (refined[0, 1], refined[4, 1]) == (1, 1)


def test_no_label_loses_its_last_pixel(cloud_of, box_on_table):
    depth, truth = box_on_table()
    cloud = cloud_of(depth)
    # Of the last label, and of one before it.
    surfaces = [*fitted(cloud, truth), None, None]
    for label in (5, 6):
        truth[120:122, 40 * label : 40 * label + 2] = label
    table, rms_per_m = SurfaceTable(surfaces), [0.0] * 6
    refined = refine_borders(truth, inverse_depth_image(cloud), table, CONFIG, rms_per_m=rms_per_m)
    assert set(np.unique(refined)) == {1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("spread_severed", [True, False])
def test_what_a_border_cuts_off_goes_to_its_neighbors_if_it_is_small(spread_severed):
    labels = np.ones((240, 320), np.int32)
    labels[:, 200:] = 2
    # A quarter of the settings' pixels: at least 30.
    labels[20:25, 20:25], labels[50:56, 20:26] = 2, 2
    refined = refine_borders(
        labels,
        np.ones(labels.shape, np.float32),
        SurfaceTable([None, None]),
        CONFIG,
        rms_per_m=[0.0, 0.0],
        sweeps=0,
        spread_severed=spread_severed,
    )
    expected = labels.copy()
    if spread_severed:
        expected[20:25, 20:25] = 1
    assert (refined == expected).all()


def test_a_single_surface_is_left_alone():
    labels = np.ones((5, 6), np.int32)
    inverse_depth = np.ones((5, 6), np.float32)
    assert refine_borders(labels, inverse_depth, SurfaceTable([None]), CONFIG, rms_per_m=[0.0]) is labels
