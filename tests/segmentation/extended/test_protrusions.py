"""What is in front of a surface becomes a leaf, but not noise, a strip, a hollow or what is too small."""

from dataclasses import replace

import numpy as np
import pytest

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Labels as the tree has them.
CONFIG = updated(SegmentationConfig(decimation=2), extended={"refine_borders": False})
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


def test_a_small_thing_before_a_wall_that_is_at_its_noise_becomes_a_leaf(cloud_of):
    tree = segment(wall(cloud_of, [(THING, 8.0)]), CONFIG)
    root = tree.root
    assert (root.division, root.stop, root.trial) == (Division.PROTRUSION, None, None)
    rest, thing = tree.leaves()
    assert np.array_equal(np.union1d(rest.fit.pixels, thing.fit.pixels), root.fit.pixels)
    expected = np.zeros(SIZE, dtype=bool)
    expected[THING] = True
    found = tree.labels("surfaces") == 2
    assert (found & expected).sum() / (found | expected).sum() > 0.95
    assert (rest.name, thing.name) == ("0", "1")
    assert thing.stop in (StopReason.NOISE, StopReason.UNTRIED)
    assert rest.stop is StopReason.NOISE
    # The surface beside the thing is no longer bent toward it.
    assert rest.fit.rms_per_m < root.fit.rms_per_m
    assert thing.cuts_above == rest.cuts_above == root.cuts_above == 0
    off = updated(CONFIG, extended={"protrusion_min": 0.0})
    assert len(segment(wall(cloud_of, [(THING, 8.0)]), off).leaves()) == 1


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
    assert len(segment(wall(cloud_of, things), replace(CONFIG, decimation=step)).leaves()) == 1


def test_in_front_of_a_surface_that_fits_badly_more_is_needed(cloud_of):
    noisier = replace(updated(CONFIG, extended={"inverse_depth_noise": 0.3 * NOISE_PER_M}), depth_max=0)
    assert len(segment(wall(cloud_of, [(THING, 8.0)]), noisier).leaves()) == 2
    # Seven times the noise of the setting, but only twice the residuals of the wall.
    assert len(segment(wall(cloud_of, [(THING, 2.0)]), noisier).leaves()) == 1


def test_a_tree_that_a_limit_stopped_is_left_as_it_is(cloud_of):
    cloud = wall(cloud_of, [(THING, 8.0)])
    # With so large a T noise is tried, too.
    (root,) = segment(cloud, replace(CONFIG, ratio_max=9.0, splits_max=0)).segments
    assert root.stop is StopReason.SPLITS


def test_several_things_are_chained_without_a_surface(cloud_of):
    other = (slice(300, 324), slice(100, 130))
    tree = segment(wall(cloud_of, [(THING, 8.0), (other, 8.0)]), CONFIG)
    assert [leaf.name for leaf in tree.leaves()] == ["0", "10", "11"]
    assert tree["1"].division is Division.GAP
    sizes = sorted(leaf.fit.pixels.size for leaf in tree.leaves())
    assert sizes == pytest.approx([120, 180, 76500], rel=0.05)
