from itertools import combinations

import numpy as np
import pytest

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.extended.border_statistics import BorderStatistics, border_statistics
from nurbseg.segmentation.extended.merge import merge_surfaces, merged_objects
from nurbseg.segmentation.points.depth_grid import depth_grid
from nurbseg.segmentation.points.rays import rays_of
from nurbseg.segmentation.surfaces.inverse_depth import fit_window

CONFIG = SegmentationConfig()
NAMES = ("00", "01", "10", "11")


def fitted(cloud, labels, step=1):
    grid = depth_grid(cloud, step)
    on_grid = labels[::step, ::step]
    surfaces = []
    for label in range(1, labels.max() + 1):
        places = np.flatnonzero((on_grid == label) & grid.valid)
        top, left, bottom, right = window = grid.points.locate(places)[2]
        mask = (on_grid == label)[top:bottom, left:right]
        surfaces.append(fit_window(grid, window, mask, CONFIG)[0].surface)
    return grid, surfaces


def test_creases_of_a_box_have_the_sign_and_size_of_their_angle(cloud_of, box_on_table):
    depth, truth = box_on_table()
    cloud = cloud_of(depth)
    _, surfaces = fitted(cloud, truth)
    found = {
        (each.first, each.second): each
        for each in border_statistics(truth, surfaces, rays_of(cloud), gap_per_m=0.02)
    }
    # Normals turned by a right angle differ by sqrt(2), as seen along a chord straight across the crease.
    for pair in ((2, 3), (2, 4), (3, 4)):
        assert found[pair].touching > 0.8 * found[pair].samples
        assert -1.45 < found[pair].concavity_sum / found[pair].touching < -0.6
    for pair in ((1, 3), (1, 4)):
        assert 0.6 < found[pair].concavity_sum / found[pair].touching < 1.45
    # The top hides a part of the table: their borders meet only in the image.
    assert found[1, 2].touching == 0


@pytest.mark.parametrize("step", [1, 2])
def test_a_box_is_an_object_and_the_table_another(cloud_of, box_on_table, step):
    depth, truth = box_on_table(noise_per_m=2e-3)
    grid, surfaces = fitted(cloud_of(depth), truth, step)
    objects, contacts = merge_surfaces(truth, grid, NAMES, surfaces, CONFIG)
    assert [each.leaves for each in objects] == [("00",), ("01", "10", "11")]
    said = {(each.first, each.second): each for each in contacts}
    assert said["01", "10"].merged
    assert "convex" in said["01", "10"].reason
    assert not said["00", "10"].merged
    assert "concave" in said["00", "10"].reason
    assert "gap" in said["00", "01"].reason
    assert not said["00", "01"].merged


def bowl(rays, size=(240, 320)):
    """The inside of a ball of 0.5 m around a point 1 m away, cut in two halves: labels 1 and 2."""
    directions = rays(size)
    a, b, c = (directions**2).sum(axis=-1), directions[..., 2], 1.0 - 0.25
    root = b**2 - a * c
    depth = np.where(root > 0.02, (b + np.sqrt(np.maximum(root, 0))) / a, np.nan)
    labels = np.where(np.isfinite(depth), 1 + (np.arange(size[1]) >= size[1] // 2), 0)
    return depth, labels.astype(np.int32)


def test_halves_of_a_bowl_are_one_object_only_by_their_smooth_border(cloud_of, rays_of_size):
    depth, labels = bowl(rays_of_size)
    rng = np.random.default_rng(0)
    grid, surfaces = fitted(cloud_of(1 / (1 / depth + 2e-3 * rng.normal(size=depth.shape))), labels, 2)
    objects, contacts = merge_surfaces(labels, grid, NAMES[:2], surfaces, CONFIG)
    assert [each.leaves for each in objects] == [("00", "01")]
    strict = SegmentationConfig(extended=ExtendedConfig(concavity_max=0.0, merge_smooth=False))
    assert len(merge_surfaces(labels, grid, NAMES[:2], surfaces, strict)[0]) == 2
    smooth = SegmentationConfig(extended=ExtendedConfig(concavity_max=0.01))
    objects, contacts = merge_surfaces(labels, grid, NAMES[:2], surfaces, smooth)
    assert len(objects) == 1
    assert contacts[0].smooth
    assert "smooth" in contacts[0].reason


def test_a_concave_crease_is_not_smooth(cloud_of, box_on_table):
    depth, truth = box_on_table(noise_per_m=1e-3)
    grid, surfaces = fitted(cloud_of(depth), truth, 2)
    _, contacts = merge_surfaces(truth, grid, NAMES, surfaces, CONFIG)
    assert not any(each.smooth for each in contacts if each.first == "00")


def test_merging_can_be_switched_off(cloud_of, box_on_table):
    depth, truth = box_on_table()
    grid, surfaces = fitted(cloud_of(depth), truth)
    off = SegmentationConfig(extended=ExtendedConfig(merge_crease=False, merge_smooth=False))
    assert merge_surfaces(truth, grid, NAMES, surfaces, off) == ((), ())


def test_surfaces_that_could_not_be_fitted_touch_nothing(cloud_of, box_on_table):
    depth, truth = box_on_table()
    grid, surfaces = fitted(cloud_of(depth), truth)
    objects, contacts = merge_surfaces(truth, grid, NAMES, [surfaces[0], None, *surfaces[2:]], CONFIG)
    assert ("01",) in [each.leaves for each in objects]
    assert all(each.touching == 0 for each in contacts if "01" in (each.first, each.second))


def test_borders_are_compared_across_a_few_pixels_without_depth(cloud_of, box_on_table):
    depth, truth = box_on_table()
    grid, surfaces = fitted(cloud_of(depth), truth)
    labels = truth
    holes = labels.copy()
    edge = (labels[:, 1:] != labels[:, :-1]).nonzero()
    holes[edge] = 0
    with_holes = {
        (each.first, each.second): each
        for each in border_statistics(holes, surfaces, grid.rays, gap_per_m=0.02)
    }
    without = {
        (each.first, each.second): each
        for each in border_statistics(labels, surfaces, grid.rays, gap_per_m=0.02)
    }
    assert with_holes[3, 4].concavity_sum / with_holes[3, 4].touching == pytest.approx(
        without[3, 4].concavity_sum / without[3, 4].touching, abs=0.05
    )


def test_a_crease_far_away_is_seen_in_spite_of_noise_that_hides_it_from_one_fit(cloud_of, rays_of_size):
    size = (240, 320)
    directions = rays_of_size(size)
    # Two walls that meet at a right angle, 3.5 m away, in a line down the image.
    walls = np.array([[0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]]) / (3.5 * 0.5)
    inverse_depth = np.einsum("hwc,kc->khw", directions, walls)
    labels = (1 + np.argmax(inverse_depth, axis=0)).astype(np.int32)
    noise = 1e-4 * np.random.default_rng(0).normal(size=size)
    grid, surfaces = fitted(cloud_of(1 / (inverse_depth.max(axis=0) + noise)), labels, 2)
    objects, contacts = merge_surfaces(labels, grid, NAMES[:2], surfaces, CONFIG)
    assert contacts[0].concavity > 1.0
    assert not contacts[0].smooth
    assert len(objects) == 2


def merged_from_scratch(found, smooth, count, config):
    """Groups by merging the least concave pair again and again, its borders added up anew each time.

    Of pairs alike in that, which smooth ones are, the one with the smallest labels goes first.
    """
    groups = [{label} for label in range(1, count + 1)]
    while True:
        able = []
        for one, other in combinations(sorted(groups, key=min), 2):
            across = [
                each
                for each in found
                if (each.first in one and each.second in other)
                or (each.first in other and each.second in one)
            ]
            samples, touching = (sum(getattr(m, name) for m in across) for name in ("samples", "touching"))
            turned = sum(m.concavity_sum for m in across if (m.first, m.second) not in smooth)
            allowed = any(config.extended.merge_crease or (m.first, m.second) in smooth for m in across)
            if allowed and touching >= 4 and touching >= samples / 2:
                able.append((turned / touching, one, other))
        able = [each for each in able if each[0] < config.extended.concavity_max]
        if not able:
            return sorted(map(sorted, groups))
        _, one, other = min(able, key=lambda each: each[0])
        groups = [each for each in groups if each not in (one, other)] + [one | other]


@pytest.mark.parametrize("seed", range(20))
def test_the_least_concave_pair_is_merged_first_and_its_borders_are_pooled(seed):
    rng = np.random.default_rng(seed)
    count = 9
    found = []
    for first, second in combinations(range(1, count + 1), 2):
        if rng.random() < 0.5:
            samples = int(rng.integers(2, 12))
            touching = int(rng.integers(samples // 3, samples + 1))
            found.append(BorderStatistics(first, second, samples, touching, touching * rng.normal(0.15, 0.2)))
    smooth = {(each.first, each.second) for each in found if rng.random() < 0.2}
    labels = rng.integers(0, count + 1, (9, 13)).astype(np.int32)
    config = SegmentationConfig(extended=ExtendedConfig(merge_crease=bool(seed % 3)))
    names = [f"{number:04b}" for number in range(count)]
    objects, contacts = merged_objects(found, smooth, labels, names, config)
    groups = merged_from_scratch(found, smooth, count, config)
    assert sorted(sorted(names.index(name) + 1 for name in each.leaves) for each in objects) == groups
    # Largest first, the leaves of each in their order.
    pixels = [sum(np.count_nonzero(labels == names.index(n) + 1) for n in each.leaves) for each in objects]
    assert pixels == sorted(pixels, reverse=True)
    assert all(list(each.leaves) == sorted(each.leaves) for each in objects)
    together = {name: each for each in objects for name in each.leaves}
    for contact, border in zip(contacts, found, strict=True):
        assert (contact.first, contact.second) == (names[border.first - 1], names[border.second - 1])
        assert (contact.samples, contact.touching) == (border.samples, border.touching)
        assert contact.merged == (together[contact.first] is together[contact.second])
        assert contact.smooth == ((border.first, border.second) in smooth)
        if border.touching:
            assert contact.concavity == border.concavity_sum / border.touching


@pytest.mark.parametrize(
    ("border", "smooth", "crease", "merged", "reason"),
    [
        ((20, 20, -8.0), False, True, True, "a convex or flat crease of -0.40"),
        ((20, 20, 2.39), False, True, True, "a convex or flat crease of 0.12"),
        ((20, 20, 2.4), False, True, False, "a concave crease of 0.12, 0.12 at most is merged"),
        ((20, 20, -8.0), False, False, False, "a convex or flat crease of -0.40"),
        ((20, 20, 8.0), True, True, True, "a smooth border: one surface explains both sides"),
        ((20, 20, 8.0), True, False, True, "a smooth border: one surface explains both sides"),
        ((20, 9, -8.0), True, True, False, "a gap: 9 of 20 places along the border touch"),
        ((3, 3, -1.0), False, True, False, "a gap: 3 of 3 places along the border touch"),
        ((3, 0, 0.0), False, True, False, "a gap: 0 of 3 places along the border touch"),
    ],
)
def test_a_contact_says_why_it_is_merged_or_not(border, smooth, crease, merged, reason):
    config = SegmentationConfig(extended=ExtendedConfig(merge_crease=crease, concavity_max=0.12))
    labels = np.array([[1, 1, 2]], dtype=np.int32)
    pairs = {(1, 2)} if smooth else set()
    objects, (contact,) = merged_objects([BorderStatistics(1, 2, *border)], pairs, labels, ("0", "1"), config)
    assert (contact.merged, contact.reason) == (merged, reason)
    assert len(objects) == 2 - merged
    assert np.isnan(contact.concavity) == (border[1] == 0)


def test_a_contact_says_that_others_joined_or_parted_it():
    labels = np.array([[1, 2, 3]], dtype=np.int32)
    convex, concave = (
        (BorderStatistics(1, 2, 20, 20, -8.0), BorderStatistics(2, 3, 20, 20, -8.0)),
        BorderStatistics(1, 3, 20, 20, 6.0),
    )
    objects, contacts = merged_objects([*convex, concave], set(), labels, NAMES[:3], CONFIG)
    assert len(objects) == 1
    assert contacts[2].reason.startswith(
        "joined through other surfaces, in spite of a concave crease of 0.30"
    )
    # The third is convex to one of two, but more concave to the other.
    weak = BorderStatistics(2, 3, 20, 20, -1.0)
    objects, contacts = merged_objects([convex[0], weak, concave], set(), labels, NAMES[:3], CONFIG)
    assert [each.leaves for each in objects] == [NAMES[:2], NAMES[2:3]]
    assert contacts[1].reason == "a convex or flat crease of -0.05, but their objects meet in a concave one"
