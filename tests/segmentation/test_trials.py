"""What a tree says of its splits can be recomputed from its segments, by both methods."""

from dataclasses import replace

import numpy as np
import pytest
from sound_tree import assert_sound

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig, Stag15Config
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.surface import evaluate
from nurbseg.segmentation.vocabulary import Division

BOTH = pytest.mark.parametrize("method", ["stag15", "nurbseg"])


def mean_square(each: Segment, cloud) -> float:
    """Mean squared distance of the fitted points to the exported surface, m^2."""
    rows, columns = np.unravel_index(each.fit.pixels, cloud.valid.shape)
    assert each.fit.surface is not None
    on_surface = evaluate(each.fit.surface, columns.astype(float), rows.astype(float))
    beside = on_surface - cloud.points_m[rows, columns].astype(float)
    return float(np.mean(np.sum(beside**2, axis=1)))


def counted(each: Segment, cloud) -> float:
    """The mean square, or what noise leaves of it where that is more."""
    return max(mean_square(each, cloud), each.fit.floor)


def parts_of(tree: SegmentationTree, each: Segment) -> list[Segment]:
    """The parts of a split: what is not connected hangs below nodes of its own."""
    found, waiting = [], [tree[name] for name in each.children]
    while waiting:
        part = waiting.pop(0)
        if part.division is Division.GAP:
            waiting[:0] = [tree[name] for name in part.children]
        else:
            found.append(part)
    return found


@BOTH
def test_ratios_follow_from_the_surfaces_and_the_pixels_that_were_fitted(cloud_of, box_on_table, method):
    cloud = cloud_of(box_on_table((240, 320), noise_per_m=1.5e-3, seed=1)[0])
    config = SegmentationConfig(
        decimation=2,
        method=method,
        splits_max=8,
        stag15=Stag15Config(segment_pixels_min=600),
        # Half the noise that there is, so that many splits are tried and some rejected.
        extended=ExtendedConfig(inverse_depth_noise=0.8e-3),
    )
    tree = segment(cloud, config)
    assert_sound(tree, cloud.valid)
    splits = [each for each in tree.segments if each.division is Division.CUT]
    assert len(splits) > 2
    for split in splits:
        parts = parts_of(tree, split)
        assert np.array_equal(
            np.sort(np.concatenate([part.fit.pixels for part in parts])), np.sort(split.fit.pixels)
        )
        after = sum(counted(part, cloud) * part.fit.pixels.size for part in parts)
        before = counted(split, cloud) * split.fit.pixels.size
        assert split.ratio == pytest.approx(after / before, rel=1e-3)
        assert split.trial is not None
        assert split.trial.kept
    rejected = [leaf for leaf in tree.leaves() if leaf.trial is not None]
    assert rejected
    for each in rejected:
        assert each.trial is not None
        assert not each.trial.kept
        assert each.trial.value == pytest.approx(counted(each, cloud), rel=1e-3)
        assert each.trial.points == each.fit.pixels.size == sum(points for _, points in each.trial.parts)


@BOTH
@pytest.mark.parametrize("rows", [[7], [7, 9, 31]])
def test_points_between_the_rows_of_the_grid_have_labels(cloud_of, method, rows):
    depth = np.full((48, 64), np.nan)
    depth[rows] = 1.0
    cloud = cloud_of(depth)
    config = SegmentationConfig(method=method, decimation=2)
    labels = segment(cloud, config).labels("surfaces")
    assert np.array_equal(labels > 0, cloud.valid)
    assert np.array_equal(labels, segment(cloud, replace(config, decimation=1)).labels("surfaces"))
