from itertools import combinations

import numpy as np
import pytest

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.objects import merge
from nurbseg.segmentation.objects.agglomeration import RENEWED, evidence, scene_of
from nurbseg.segmentation.objects.border_statistics import (
    SAMPLES,
    SUMS,
    TOUCHING,
    BorderStatistics,
    add_border,
)
from nurbseg.segmentation.objects.merge import ITEMS, Measured, merged_objects
from nurbseg.segmentation.objects.pair_features import NODE, merging_model, model_of
from nurbseg.segmentation.objects.surface_statistics import surface_statistics
from nurbseg.segmentation.points.grid import depth_grid

CONFIG = SegmentationConfig()
NAMES = ("00", "01", "10", "11")


def test_a_bowl_that_fills_the_frame_is_one_object(cloud_of, rays_of_size):
    """Seen far down its sides, it is two surfaces."""
    directions = rays_of_size((240, 320))
    a, b = (directions**2).sum(axis=-1), directions[..., 2]
    root = b**2 - 0.75 * a
    depth = np.where(root > 4e-4, (b + np.sqrt(np.maximum(root, 0))) / a, np.nan)
    for seed in range(2):
        noise = 2e-3 * np.random.default_rng(seed).normal(size=depth.shape)
        tree = segment(cloud_of(1 / (1 / depth + noise)), SegmentationConfig(seed=seed))
        assert len(tree.leaves()) > 1
        assert len(tree.objects) == 1


def made_up(pairs, log_odds, samples, count):
    """Pairs with one item of evidence each, and borders whose sums are all different."""
    items = np.zeros((len(pairs), len(ITEMS)))
    items[:, 0] = log_odds
    rng = np.random.default_rng(count)
    sums = rng.uniform(0, 1, (len(pairs), SUMS))
    sums[:, SAMPLES] = samples
    surfaces = rng.uniform(1, 2, (count + 1, 19))
    surfaces[0] = 0
    borders = BorderStatistics(np.array(pairs, dtype=np.int64).reshape(-1, 2), sums)
    return borders, surfaces, items


def merged_from_scratch(borders, surfaces, scene, items, samples, count, least):
    """Merge the likeliest groups again and again; all that is known of them is added up anew each time.

    Of pairs alike in that, the one with the smallest labels goes first.
    """
    pairs, model, groups = borders.labels.tolist(), merging_model(), [{k} for k in range(1, count + 1)]
    made = []
    while True:
        able = []
        for one, other in combinations(sorted(groups, key=min), 2):
            across = [n for n, pair in enumerate(pairs) if len({*pair} & one) == len({*pair} & other) == 1]
            if not across:
                continue
            total = sum(samples[n] for n in across)
            mean = sum(items[n, :-1].sum() * samples[n] for n in across) / total
            kept = sum(items[n, -1] * samples[n] for n in across) / total
            odds = mean
            if len(one) + len(other) > 2:
                odds = (
                    RENEWED * renewed(borders, surfaces, scene, model, groups, one, other)
                    + (1 - RENEWED) * mean
                )
            able.append((round(odds + kept, 3), one, other))
        able = [each for each in able if each[0] > least]
        if not able:
            return sorted(map(sorted, groups)), made
        odds, one, other = max(able, key=lambda each: each[0])
        made.append((min(one), min(other), odds))
        groups = [group for group in groups if group not in (one, other)] + [one | other]


def renewed(borders, surfaces, scene, model, groups, one, other):
    """Evidence of two groups, as that of two labels of a frame in which every group is one label."""
    number = {label: n for n, group in enumerate(sorted(groups, key=min), start=1) for label in group}
    sums: dict[tuple[int, int], np.ndarray] = {}
    for (first, second), own in zip(borders.labels.tolist(), borders.sums, strict=True):
        a, b = number[first], number[second]
        if a != b:
            add_border(sums.setdefault((min(a, b), max(a, b)), np.zeros(SUMS)), own, a > b)
    joint = np.zeros((len(groups) + 1, surfaces.shape[1]))
    for label, n in number.items():
        joint[n] += surfaces[label]
    pairs = sorted(sums)
    found = evidence(np.array(pairs), np.array([sums[pair] for pair in pairs]), joint, scene, model)
    return found[pairs.index(tuple(sorted((number[min(one)], number[min(other)]))))].sum()


@pytest.mark.parametrize("seed", range(12))
def test_the_likeliest_pair_is_merged_first_and_its_evidence_computed_again(cloud_of, box_on_table, seed):
    depth, truth = box_on_table(noise_per_m=2e-3)
    grid = depth_grid(cloud_of(depth), 2)
    rng = np.random.default_rng(seed)
    # Blocks of the image as surfaces, one of which is the largest: it is the support.
    blocks = np.arange(1, 13).reshape(3, 4).repeat([50, 110, 80], axis=0).repeat([40, 120, 60, 100], axis=1)
    assert blocks.shape == truth.shape
    labels = np.ascontiguousarray(rng.permutation(np.arange(13))[blocks].astype(np.int32))
    count = 12
    surfaces = surface_statistics(labels[::2, ::2], count, grid)
    pairs = [pair for pair in combinations(range(1, count + 1), 2) if rng.random() < 0.4]
    samples = rng.integers(1, 90, len(pairs)).astype(float)
    borders, _, items = made_up(pairs, np.round(rng.normal(0.5, 1, len(pairs)), 3), samples, count)
    items[:, -1] = rng.choice([-1.5, 0.0, 1.5], len(pairs))
    scene, least = scene_of(surfaces, grid, 2e-3), [0.0, 0.5, -0.25][seed % 3]
    names = [f"{number:04b}" for number in range(count)]
    config = SegmentationConfig(extended=ExtendedConfig(log_odds_min=least))
    found = merged_objects(Measured(borders, surfaces, scene, items), labels, names, config)
    groups, merges = merged_from_scratch(borders, surfaces, scene, items, samples, count, least)
    assert sorted(sorted(names.index(n) + 1 for n in each.leaves) for each in found.objects) == groups
    assert len(groups) < count
    # Largest first, the leaves of each in their order.
    pixels = [sum(np.count_nonzero(labels == names.index(n) + 1) for n in o.leaves) for o in found.objects]
    assert pixels == sorted(pixels, reverse=True)
    assert all(list(each.leaves) == sorted(each.leaves) for each in found.objects)
    together = {name: each for each in found.objects for name in each.leaves}
    for contact, pair, own in zip(found.contacts, pairs, items, strict=True):
        assert (contact.first, contact.second) == tuple(names[label - 1] for label in pair)
        assert contact.log_odds == pytest.approx(own.sum(), abs=1e-9)
        assert contact.merged == (together[contact.first] is together[contact.second])
    # What was merged joins leaves to objects; what was refused lies between these.
    made = [each for each in found.merges if each.merged]
    assert len(made) == count - len(groups)
    for each, (first, second, odds) in zip(made, merges, strict=True):
        assert (each.first, each.second) == (names[first - 1], names[second - 1])
        assert each.log_odds == pytest.approx(odds, abs=1.1e-3) and each.log_odds > least
    for each in found.merges[len(made) :]:
        assert not each.merged and each.log_odds <= least
        assert together[each.first] is not together[each.second]


@pytest.mark.parametrize(
    ("items", "merged", "reason"),
    [
        ((1.5, -0.25, 2.0), True, "log odds of +3.25, of which height +2.0 and crease -0.2"),
        ((1.5, -3.0, 1.25), False, "log odds of -0.25, of which height +1.2 and crease -3.0"),
        # At the limit it is not merged, and no other surface is the reason.
        ((0.5, -1.5, 1.0), False, "log odds of +0.00, of which height +1.0 and crease -1.5"),
        ((0.5, -1.0, 0.0), False, "log odds of -0.50, of which crease -1.0"),
    ],
)
def test_a_contact_says_why_it_is_merged_or_not(cloud_of, box_on_table, items, merged, reason):
    depth, _ = box_on_table()
    grid, labels, names = (
        depth_grid(cloud_of(depth), 1),
        np.array([[1, 1, 2]], np.int32),
        ("base", "crease", "height"),
    )
    borders, surfaces, row = made_up([(1, 2)], [0.0], [20.0], 2)
    row[0, [ITEMS.index(name) for name in names]] = items
    borders.sums[0, TOUCHING] = 3
    measured = Measured(borders, surfaces, scene_of(surfaces, grid, 2e-3), row)
    objects, (contact,), merges = merged_objects(measured, labels, ("0", "1"), CONFIG)
    assert (contact.merged, contact.reason) == (merged, reason)
    assert len(objects) == 2 - merged
    assert (contact.samples, contact.touching) == (20, 3)
    assert contact.log_odds == sum(items)
    assert contact.evidence == {name: item for name, item in zip(names, items, strict=True) if item}
    assert [each.log_odds for each in merges] == [sum(items)] * merged


@pytest.fixture
def renewed_as(monkeypatch):
    """A function that makes the evidence that is computed again a constant."""

    def set_to(log_odds):
        leaf = np.array([(0, 0.0, -1, -1, log_odds)], dtype=NODE)
        monkeypatch.setattr(merge, "merging_model", lambda: model_of(leaf))

    return set_to


def merged_of_three(cloud_of, box_on_table, log_odds, samples):
    grid, labels = depth_grid(cloud_of(box_on_table()[0]), 1), np.array([[1, 2, 3]], dtype=np.int32)
    borders, surfaces, items = made_up([(1, 2), (1, 3), (2, 3)], log_odds, samples, 3)
    measured = Measured(borders, surfaces, scene_of(surfaces, grid, 2e-3), items)
    return merged_objects(measured, labels, NAMES[:3], CONFIG)


def test_a_contact_says_that_others_merged_or_separated_it(cloud_of, box_on_table, renewed_as):
    renewed_as(1.0)
    _, contacts, merges = merged_of_three(cloud_of, box_on_table, [2.0, -0.5, 2.0], [9, 9, 9])
    assert contacts[1].reason == "merged through other surfaces, despite log odds of -0.50"
    # Three quarters of 1, and a quarter of the mean of -0.5 and 2, rounded to the even digit.
    assert [each.log_odds for each in merges] == pytest.approx([2.0, 0.9375], abs=6e-4)
    renewed_as(-1.0)
    _, contacts, merges = merged_of_three(cloud_of, box_on_table, [2.0, -1.5, 1.0], [9, 9, 9])
    why = "log odds of +1.00, but those of the objects they belong to are too low"
    assert contacts[2].reason == why
    assert [each.merged for each in merges] == [True, False]
    assert merges[1].evidence == {"base": -1.0}
    assert merges[1].log_odds == pytest.approx(-0.75 + 0.25 * -0.25, abs=6e-4)


def test_a_weak_border_does_not_join_what_a_long_one_parts(cloud_of, box_on_table, renewed_as):
    # Surface 3 is likelier one with 2 than not, but its long border with 1, which goes with 2, says no.
    renewed_as(0.0)
    for length, count in ((50, 2), (5, 1)):
        found = merged_of_three(cloud_of, box_on_table, [3.0, -1.0, 1.0], [10, length, 10])
        assert len(found.objects) == count
