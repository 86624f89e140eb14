"""What is in front of a surface becomes a leaf, but not noise, a strip, a hollow or what is too small."""

from dataclasses import replace

import numpy as np
import pytest

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.grid_features import grid_features
from nurbseg.segmentation.extended.memory import Attempt, LeafMemory
from nurbseg.segmentation.extended.parts import fit_segment
from nurbseg.segmentation.extended.protrusions import split_off_protrusions
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.segments import Node, depth_first
from nurbseg.segmentation.vocabulary import Division, StopReason

CONFIG = SegmentationConfig(decimation=2)
NOISE_PER_M = CONFIG.extended.inverse_depth_noise
SIZE = (480, 640)
THING = (slice(200, 224), slice(300, 320))


def wall(cloud_of, things, seed=0):
    """Return a sloping wall with noise, in front of which some pixels are by so many deviations."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    inverse_depth = 1.0 + 4e-4 * columns + 2e-4 * rows
    inverse_depth = inverse_depth + NOISE_PER_M * np.random.default_rng(seed).standard_normal(SIZE)
    for where, deviations in things:
        inverse_depth[where] += deviations * NOISE_PER_M
    return cloud_of(1.0 / inverse_depth)


def split_off(cloud_of, things, config=CONFIG, stop=None):
    """Return the tree of a wall that no cut divided, and its grid's shape."""
    features = grid_features(wall(cloud_of, things), config)
    part = fit_segment(features, np.flatnonzero(features.grid.valid), config)
    root = Node("", part.grid_pixels, part.fit, stop=stop or part.stop)
    split_off_protrusions(root, features, config)
    return root, features.grid.valid.shape


def test_a_small_thing_before_a_wall_that_is_at_its_noise_becomes_a_leaf(cloud_of):
    root, shape = split_off(cloud_of, [(THING, 8.0)])
    assert root.division is Division.PROTRUSION
    assert (root.stop, root.trial) == (None, None)
    rest, thing = root.children
    assert np.array_equal(np.union1d(rest.grid_pixels, thing.grid_pixels), root.grid_pixels)
    expected = np.zeros(shape, dtype=bool)
    expected[100:112, 150:160] = True
    found = np.zeros(shape, dtype=bool)
    found.ravel()[thing.grid_pixels] = True
    assert (found & expected).sum() / (found | expected).sum() > 0.95
    assert (rest.name, thing.name) == ("0", "1")
    assert thing.stop in (StopReason.NOISE, StopReason.UNTRIED)
    assert rest.stop is StopReason.NOISE
    # The surface beside the thing is no longer bent toward it.
    assert rest.fit.rms_per_m < root.fit.rms_per_m
    assert thing.cuts_above == rest.cuts_above == root.cuts_above


def test_what_was_tried_of_a_leaf_is_forgotten_when_it_loses_a_thing(cloud_of):
    features = grid_features(wall(cloud_of, [(THING, 8.0)]), CONFIG)
    part = fit_segment(features, np.flatnonzero(features.grid.valid), CONFIG)
    memory = LeafMemory(0, Attempt(StopReason.CRITERION, None, 0, 0.0, part.grid_pixels.size), far=100)
    root = Node("", part.grid_pixels, part.fit, stop=StopReason.CRITERION, memory=memory)
    split_off_protrusions(root, features, CONFIG)
    rest, thing = root.children
    assert (root.memory, rest.memory, thing.memory) == (None, memory, None)
    assert (memory.attempt, memory.far) == (None, None)


@pytest.mark.parametrize(
    ("things", "step"),
    [
        ([], 2),
        ([(THING, -8.0)], 2),
        ([(THING, 1.0)], 2),
        ([((slice(100, 300), slice(300, 306)), 8.0)], 2),
        ([((slice(100, 400), slice(300, 306)), 8.0)], 3),
        ([((slice(200, 208), slice(300, 310)), 20.0)], 2),
    ],
    ids=[
        "noise",
        "a hollow",
        "within noise",
        "a strip",
        "a strip in thirds",
        "fewer points than T_p",
    ],
)
def test_a_wall_stays_whole(cloud_of, things, step):
    root, _ = split_off(cloud_of, things, replace(CONFIG, decimation=step))
    assert root.children == ()


def test_in_front_of_a_surface_that_fits_badly_more_is_needed(cloud_of):
    noisier = updated(CONFIG, extended={"inverse_depth_noise": 0.3 * NOISE_PER_M})
    assert split_off(cloud_of, [(THING, 8.0)], noisier)[0].children != ()
    # Seven times the noise of the setting, but only twice the residuals of the wall.
    assert split_off(cloud_of, [(THING, 2.0)], noisier)[0].children == ()


@pytest.mark.parametrize(("columns", "parts"), [(240, 2), (400, 0)])
def test_where_most_of_a_leaf_is_in_front_of_its_surface_the_surface_is_what_is_wrong(
    cloud_of, columns, parts
):
    everywhere = np.arange(SIZE[0] * SIZE[1] // 4)
    behind = fit_segment(grid_features(wall(cloud_of, []), CONFIG), everywhere, CONFIG)
    features = grid_features(wall(cloud_of, [((slice(None), slice(columns)), 20.0)]), CONFIG)
    # Residuals only say which points to look at.
    fit = replace(behind.fit, residuals_m=np.ones(everywhere.size))
    root = Node("", everywhere, fit)
    split_off_protrusions(root, features, CONFIG)
    assert len(root.children) == parts


@pytest.mark.parametrize("stop", [StopReason.SPLITS, StopReason.BUDGET])
def test_a_tree_that_a_limit_stopped_is_left_as_it_is(cloud_of, stop):
    root, _ = split_off(cloud_of, [(THING, 8.0)], stop=stop)
    assert root.children == ()
    assert root.stop is stop


def test_several_things_are_chained_without_a_surface(cloud_of):
    other = (slice(300, 324), slice(100, 130))
    root, _ = split_off(cloud_of, [(THING, 8.0), (other, 8.0)])
    leaves = [node for node in depth_first(root) if not node.children]
    assert [leaf.name for leaf in leaves] == ["0", "10", "11"]
    assert root.children[1].division is Division.GAP
    assert sorted(leaf.grid_pixels.size for leaf in leaves) == pytest.approx([120, 180, 76500], rel=0.05)


def test_a_frame_has_the_thing_as_a_surface_unless_the_limit_is_0(cloud_of):
    cloud = wall(cloud_of, [(THING, 8.0)])
    labels = segment(cloud, CONFIG).labels("surfaces")
    assert labels.max() == 2
    thing = labels == labels[212, 310]
    expected = np.zeros(SIZE, dtype=bool)
    expected[THING] = True
    assert (thing & expected).sum() / (thing | expected).sum() > 0.9
    off = replace(CONFIG, extended=updated(CONFIG, extended={"protrusion_min": 0.0}).extended)
    assert segment(cloud, off).labels("surfaces").max() == 1
