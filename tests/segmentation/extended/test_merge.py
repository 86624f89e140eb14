import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.contact import meetings
from nurbseg.segmentation.extended.merge import merge_surfaces
from nurbseg.segmentation.points.rays import rays_of
from nurbseg.segmentation.surfaces.inverse_depth import depth_grid, fit_window

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
        (each.first, each.second): each for each in meetings(truth, surfaces, rays_of(cloud), gap_per_m=0.02)
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
    strict = SegmentationConfig(concavity_max=0.0, merge_smooth=False)
    assert len(merge_surfaces(labels, grid, NAMES[:2], surfaces, strict)[0]) == 2
    smooth = SegmentationConfig(concavity_max=0.01)
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
    off = SegmentationConfig(merge_crease=False, merge_smooth=False)
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
        (each.first, each.second): each for each in meetings(holes, surfaces, grid.rays, gap_per_m=0.02)
    }
    without = {
        (each.first, each.second): each for each in meetings(labels, surfaces, grid.rays, gap_per_m=0.02)
    }
    assert with_holes[3, 4].concavity_sum / with_holes[3, 4].touching == pytest.approx(
        without[3, 4].concavity_sum / without[3, 4].touching, abs=0.05
    )


def test_a_crease_far_away_is_seen_in_spite_of_noise_that_hides_it_from_one_fit(cloud_of, rays_of_size):
    size = (240, 320)
    directions = rays_of_size(size)
    # Two walls that meet at a right angle, 3.5 m away, in a line down the image.
    walls = np.array([[0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]]) / (3.5 * 0.5)
    per_m = np.einsum("hwc,kc->khw", directions, walls)
    labels = (1 + np.argmax(per_m, axis=0)).astype(np.int32)
    noise = 1e-4 * np.random.default_rng(0).normal(size=size)
    grid, surfaces = fitted(cloud_of(1 / (per_m.max(axis=0) + noise)), labels, 2)
    objects, contacts = merge_surfaces(labels, grid, NAMES[:2], surfaces, CONFIG)
    assert contacts[0].concavity > 1.0
    assert not contacts[0].smooth
    assert len(objects) == 2
