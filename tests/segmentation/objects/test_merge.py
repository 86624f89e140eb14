from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.objects.border_statistics import BorderStatistics, border_statistics
from nurbseg.segmentation.objects.evidence import ITEMS
from nurbseg.segmentation.objects.merge import (
    agglomerate,
    merge_surfaces,
    merged_objects,
)
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.surfaces.inverse_depth import fit_window
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

CONFIG = SegmentationConfig()
NAMES = ("00", "01", "10", "11")


def fitted(cloud, labels, step=1):
    grid = depth_grid(cloud, step)
    on_grid = labels[::step, ::step]
    surfaces = []
    for label in range(1, labels.max() + 1):
        places = np.flatnonzero((on_grid == label) & grid.valid)
        top, left, bottom, right = window = grid.window_mask(places)[0]
        mask = (on_grid == label)[top:bottom, left:right]
        surfaces.append(fit_window(grid, window, mask, CONFIG).surface)
    return grid, surfaces


def measured(labels, surfaces, rays):
    """Share of touching places and mean concavity of each pair."""
    found = border_statistics(labels, SurfaceTable(surfaces).slopes, rays, gap_per_m=0.02)
    return {
        tuple(pair): (touching / samples, concavity / max(touching, 1))
        for pair, samples, touching, concavity in zip(
            found.labels.tolist(), found.samples, found.touching, found.concavity, strict=True
        )
    }


def test_creases_of_a_box_have_the_sign_and_size_of_their_angle(cloud_of, box_on_table):
    depth, truth = box_on_table()
    cloud = cloud_of(depth)
    _, surfaces = fitted(cloud, truth)
    found = measured(truth, surfaces, cloud.rays)
    # Normals turned by a right angle differ by sqrt(2), as seen along a chord straight across the crease.
    for pair in ((2, 3), (2, 4), (3, 4)):
        assert found[pair][0] > 0.8
        assert -1.45 < found[pair][1] < -0.6
    for pair in ((1, 3), (1, 4)):
        assert 0.6 < found[pair][1] < 1.45
    # The top hides a part of the table: their borders meet only in the image.
    assert found[1, 2][0] == 0


@pytest.mark.parametrize("step", [1, 2])
def test_a_box_is_an_object_and_the_table_another(cloud_of, box_on_table, step):
    depth, truth = box_on_table(noise_per_m=2e-3)
    grid, surfaces = fitted(cloud_of(depth), truth, step)
    objects, contacts = merge_surfaces(truth, grid, NAMES, SurfaceTable(surfaces), CONFIG)
    assert [each.leaves for each in objects] == [("00",), ("01", "10", "11")]
    said = {(each.first, each.second): each for each in contacts}
    assert said["01", "10"].merged
    assert said["01", "10"].log_odds > 2
    assert not said["00", "10"].merged
    assert said["00", "10"].log_odds < -2
    assert said["00", "10"].evidence["concave"] < said["01", "10"].evidence["concave"]
    assert said["00", "01"].reason == "a gap: the surfaces touch at 0 of 152 samples of the border"
    assert not said["00", "01"].merged


def of_pixels(labels, objects):
    """Object of each pixel, as a set of pixels for each object."""
    return {
        frozenset(np.flatnonzero(np.isin(labels, [NAMES.index(n) + 1 for n in o.leaves]))) for o in objects
    }


def test_the_order_of_labels_changes_nothing(cloud_of, box_on_table):
    depth, truth = box_on_table(noise_per_m=2e-3)
    cloud = cloud_of(depth)
    order = np.array([0, 3, 1, 4, 2], dtype=np.int32)
    odds = []
    for labels in (truth, order[truth]):
        grid, surfaces = fitted(cloud, labels, 2)
        objects, contacts = merge_surfaces(labels, grid, NAMES, SurfaceTable(surfaces), CONFIG)
        assert of_pixels(labels, objects) == {
            frozenset(np.flatnonzero(truth == 1)),
            frozenset(np.flatnonzero(truth > 1)),
        }
        odds.append(sorted(each.log_odds for each in contacts))
    assert odds[0] == odds[1]


def test_a_mirrored_frame_has_mirrored_objects(cloud_of, box_on_table):
    depth, truth = box_on_table(noise_per_m=2e-3)
    odds = []
    for turn in (slice(None), slice(None, None, -1)):
        labels = np.ascontiguousarray(truth[:, turn])
        grid, surfaces = fitted(cloud_of(depth[:, turn]), labels)
        objects, contacts = merge_surfaces(labels, grid, NAMES, SurfaceTable(surfaces), CONFIG)
        assert [each.leaves for each in objects] == [("00",), ("01", "10", "11")]
        odds.append([each.log_odds for each in contacts])
    # Knots lie on a lattice that is not the same from the other side.
    assert odds[0] == pytest.approx(odds[1], abs=0.2)


def bowl(rays, size=(240, 320)):
    """The inside of a ball of 0.5 m around a point 1 m away, cut in two halves: labels 1 and 2."""
    directions = rays(size)
    a, b, c = (directions**2).sum(axis=-1), directions[..., 2], 1.0 - 0.25
    root = b**2 - a * c
    depth = np.where(root > 0.02, (b + np.sqrt(np.maximum(root, 0))) / a, np.nan)
    labels = np.where(np.isfinite(depth), 1 + (np.arange(size[1]) >= size[1] // 2), 0)
    return depth, labels.astype(np.int32)


def test_halves_of_a_bowl_are_one_object(cloud_of, rays_of_size):
    depth, labels = bowl(rays_of_size)
    rng = np.random.default_rng(0)
    grid, surfaces = fitted(cloud_of(1 / (1 / depth + 2e-3 * rng.normal(size=depth.shape))), labels, 2)
    objects, (contact,) = merge_surfaces(labels, grid, NAMES[:2], SurfaceTable(surfaces), CONFIG)
    assert [each.leaves for each in objects] == [("00", "01")]
    strict = SegmentationConfig(extended=ExtendedConfig(log_odds_min=contact.log_odds))
    assert len(merge_surfaces(labels, grid, NAMES[:2], SurfaceTable(surfaces), strict)[0]) == 2
    loose = SegmentationConfig(extended=ExtendedConfig(log_odds_min=contact.log_odds - 1e-3))
    assert len(merge_surfaces(labels, grid, NAMES[:2], SurfaceTable(surfaces), loose)[0]) == 1


def test_merging_can_be_switched_off(cloud_of, box_on_table):
    depth, truth = box_on_table()
    grid, surfaces = fitted(cloud_of(depth), truth)
    off = SegmentationConfig(extended=ExtendedConfig(merge_surfaces=False))
    assert merge_surfaces(truth, grid, NAMES, SurfaceTable(surfaces), off) == ((), ())


def test_surfaces_that_could_not_be_fitted_touch_nothing(cloud_of, box_on_table):
    depth, truth = box_on_table()
    grid, surfaces = fitted(cloud_of(depth), truth)
    table = SurfaceTable([surfaces[0], None, *surfaces[2:]])
    objects, contacts = merge_surfaces(truth, grid, NAMES, table, CONFIG)
    assert ("01",) in [each.leaves for each in objects]
    assert all(each.touching == 0 for each in contacts if "01" in (each.first, each.second))


def test_borders_are_compared_across_a_few_pixels_without_depth(cloud_of, box_on_table):
    depth, truth = box_on_table()
    grid, surfaces = fitted(cloud_of(depth), truth)
    holes = truth.copy()
    edge = (truth[:, 1:] != truth[:, :-1]).nonzero()
    holes[edge] = 0
    with_holes, without = (measured(labels, surfaces, grid.rays) for labels in (holes, truth))
    assert with_holes[3, 4][1] == pytest.approx(without[3, 4][1], abs=0.05)


def borders_of(pairs, log_odds, samples):
    """Borders with one item of evidence, all of whose places touch, and their evidence."""
    items = np.zeros((len(pairs), len(ITEMS)))
    items[:, 0] = log_odds
    places, nothing = np.array(samples, dtype=float), np.zeros(len(pairs))
    labels = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return BorderStatistics(labels, places, places, nothing, nothing, nothing), items


def merged_from_scratch(pairs, log_odds, samples, count, least):
    """Groups by merging the likeliest pair again and again, its borders added up anew each time.

    Of pairs alike in that, the one with the smallest labels goes first.
    """
    groups = [{label} for label in range(1, count + 1)]
    while True:
        able = []
        for one, other in combinations(sorted(groups, key=min), 2):
            across = [
                n for n, (a, b) in enumerate(pairs) if (a in one and b in other) or (a in other and b in one)
            ]
            if across:
                total = sum(Fraction(round(1000 * log_odds[n]), 1000) * samples[n] for n in across)
                able.append((total / sum(samples[n] for n in across), one, other))
        able = [each for each in able if each[0] > least]
        if not able:
            return sorted(map(sorted, groups))
        _, one, other = max(able, key=lambda each: each[0])
        groups = [each for each in groups if each not in (one, other)] + [one | other]


@pytest.mark.parametrize("seed", range(40))
def test_the_likeliest_pair_is_merged_first_and_its_borders_are_averaged(seed):
    rng = np.random.default_rng(seed)
    count, least = 10, [0.0, 0.5, -0.25, 0.0][seed % 4]
    pairs = [pair for pair in combinations(range(1, count + 1), 2) if rng.random() < 0.5]
    # Of few values, so that many pairs are alike.
    log_odds = (rng.integers(-6, 7, len(pairs)) / 4 if seed % 2 else rng.normal(0, 1, len(pairs))).tolist()
    samples = rng.integers(1, 5 if seed % 2 else 90, len(pairs)).tolist()
    groups = merged_from_scratch(pairs, log_odds, samples, count, least)
    found = agglomerate(pairs, log_odds, samples, count, least)
    assert found == [0, *(min(next(g for g in groups if label in g)) for label in range(1, count + 1))]

    labels = rng.integers(0, count + 1, (9, 13)).astype(np.int32)
    names = [f"{number:04b}" for number in range(count)]
    config = SegmentationConfig(extended=ExtendedConfig(log_odds_min=least))
    objects, contacts = merged_objects(*borders_of(pairs, log_odds, samples), labels, names, config)
    assert sorted(sorted(names.index(name) + 1 for name in each.leaves) for each in objects) == groups
    # Largest first, the leaves of each in their order.
    pixels = [sum(np.count_nonzero(labels == names.index(n) + 1) for n in each.leaves) for each in objects]
    assert pixels == sorted(pixels, reverse=True)
    assert all(list(each.leaves) == sorted(each.leaves) for each in objects)
    together = {name: each for each in objects for name in each.leaves}
    for contact, (first, second), odds, length in zip(contacts, pairs, log_odds, samples, strict=True):
        assert (contact.first, contact.second) == (names[first - 1], names[second - 1])
        assert (contact.samples, contact.log_odds) == (length, round(odds, 3))
        assert contact.merged == (together[contact.first] is together[contact.second])


def test_a_weak_border_does_not_join_what_a_long_one_parts():
    # Surface 3 is likelier one with 2 than not, but its long border with 1, which goes with 2, says no.
    pairs, log_odds = [(1, 2), (1, 3), (2, 3)], [3.0, -1.0, 1.0]
    assert agglomerate(pairs, log_odds, [10, 50, 10], 3) == [0, 1, 1, 3]
    assert agglomerate(pairs, log_odds, [10, 5, 10], 3) == [0, 1, 1, 1]


@pytest.mark.parametrize(
    ("items", "merged", "reason"),
    [
        ((1.5, -0.25, 2.0, 0.0), True, "log odds of +3.25, of which front +2.0 and concave -0.2"),
        ((1.5, -3.0, 1.25, 0.0), False, "log odds of -0.25, of which front +1.2 and concave -3.0"),
        # At the limit it is not merged, and no other surface is the reason.
        ((0.5, -1.5, 1.0, 0.0), False, "log odds of +0.00, of which front +1.0 and concave -1.5"),
        ((0.5, -1.0, 0.0, 0.0), False, "log odds of -0.50, of which concave -1.0"),
        ((0.0, 0.0, 0.0, -1.5), False, "a gap: the surfaces touch at 3 of 20 samples of the border"),
    ],
)
def test_a_contact_says_why_it_is_merged_or_not(items, merged, reason):
    labels, names = np.array([[1, 1, 2]], dtype=np.int32), ("base", "concave", "front", "gap")
    row = np.zeros((1, len(ITEMS)))
    row[0, [ITEMS.index(name) for name in names]] = items
    borders = BorderStatistics(np.array([[1, 2]]), *np.array([[20.0], [3.0], [0.0], [0.0], [0.0]]))
    objects, (contact,) = merged_objects(borders, row, labels, ("0", "1"), CONFIG)
    assert (contact.merged, contact.reason) == (merged, reason)
    assert len(objects) == 2 - merged
    assert (contact.samples, contact.touching) == (20, 3)
    assert contact.log_odds == sum(items)
    assert contact.evidence == {name: item for name, item in zip(names, items, strict=True) if item}


def test_a_contact_says_that_others_merged_or_separated_it():
    labels = np.array([[1, 2, 3]], dtype=np.int32)
    pairs = [(1, 2), (1, 3), (2, 3)]
    _, contacts = merged_objects(*borders_of(pairs, [2.0, -0.5, 2.0], [9, 9, 9]), labels, NAMES[:3], CONFIG)
    assert contacts[1].reason == "merged through other surfaces, despite log odds of -0.50"
    _, contacts = merged_objects(*borders_of(pairs, [2.0, -1.5, 1.0], [9, 9, 9]), labels, NAMES[:3], CONFIG)
    assert contacts[2].reason == "log odds of +1.00, but the average over their objects' borders is too low"
