"""Leaves of different branches become one where they meet smoothly and one surface explains both."""

from dataclasses import replace

import numpy as np
import pytest
from plates import CONFIG as STIFF
from plates import PLATES, plates
from rendered import rendered

from nurbseg.common.frame import RGBDFrame
from nurbseg.common.settings import updated
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.judged import JudgedSplit
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, register
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import acceptance_ratio
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Cuts and folds alone, and leaves as they were fitted.
ALONE = {"protrusion_min": 0.0, "split_creases": False, "refine_borders": False}
CONFIG = updated(STIFF, extended=ALONE)
RENDERED = updated(
    SegmentationConfig(metric="vmxc", ratio_max=0.8, seed=3),
    extended={"inverse_depth_noise": 2.5e-3, **ALONE},
)


def without_folds(config: SegmentationConfig) -> SegmentationConfig:
    return updated(config, extended={"fold_surfaces": False})


def rendered_frame() -> RGBDFrame:
    with open_source(rendered("frames=1&labels=surfaces&seed=0")) as source:
        return source.read()


def folds(cloud: PointMap, config: SegmentationConfig) -> tuple[SegmentationTree, list[JudgedSplit]]:
    """Segment a frame; return the comparisons of two leaves with one surface for both, too."""
    judged: list[JudgedSplit] = []
    tree = segment(cloud, config, observe=judged.append)
    return tree, [each for each in judged if each.folded]


def pixels_of(*fits: Fit) -> frozenset[int]:
    return frozenset(np.concatenate([fit.pixels for fit in fits]).tolist())


@pytest.mark.parametrize("scene", ["plates", "one plate", "rendered"])
def test_leaves_become_one_where_the_ratio_rejects_them_as_two_and_nowhere_else(scene: str) -> None:
    config = RENDERED if scene == "rendered" else CONFIG
    shown = PLATES if scene == "plates" else PLATES[:1]
    cloud = register(rendered_frame()) if scene == "rendered" else plates(*shown)
    tree, judged = folds(cloud, config)
    before = {pixels_of(leaf.fit) for leaf in segment(cloud, without_folds(config)).leaves()}
    after = {pixels_of(leaf.fit) for leaf in tree.leaves()}
    assert len(after) < len(before)
    assert all(any(leaf <= joined for joined in after) for leaf in before)
    rejected = {pixels_of(*each.fits) for each in judged if not each.trial.kept}
    assert after - before <= rejected
    for each in judged:
        trial = each.trial
        assert trial.points == sum(fit.pixels.size for fit in each.fits) == sum(n for _, n in trial.parts)
        ratio = acceptance_ratio(trial.metric, (trial.value, trial.points), *trial.parts)
        assert trial.ratio == pytest.approx(ratio, rel=1e-9)
        assert trial.kept == (ratio < config.ratio_max)
    # Two that are apart in the end were better as two, but for what a split above them would not survive.
    apart = [each.trial.kept for each in judged if {pixels_of(fit) for fit in each.fits} <= after]
    assert apart.count(False) < 0.1 * len(apart)
    for node in tree.segments:
        below = [leaf.fit for leaf in tree.leaves() if leaf.name.startswith(node.name)]
        assert pixels_of(node.fit) == pixels_of(*below)
        if node.division is Division.CUT:
            assert node.trial is not None
            assert node.trial.kept
            assert (node.trial.points, node.trial.metric) == (node.fit.pixels.size, config.metric)
            depths = {tree[child].cuts_above for child in node.children}
            assert depths == {node.cuts_above + 1}


def test_a_tree_that_a_limit_stopped_stays_as_it_is() -> None:
    cloud = plates(*PLATES)
    for splits in (2, 3):
        limited = replace(CONFIG, splits_max=splits)
        tree, judged = folds(cloud, limited)
        assert not judged
        assert StopReason.SPLITS in {leaf.stop for leaf in tree.leaves()}
        assert np.array_equal(
            tree.labels("surfaces"), segment(cloud, without_folds(limited)).labels("surfaces")
        )


def test_a_table_that_the_first_cuts_tear_is_one_surface():
    frame = rendered_frame()
    cloud, torn = register(frame), without_folds(SegmentationConfig())
    tables = [
        Contingency.between(segment(cloud, config).labels("surfaces"), np.minimum(frame.labels, 2))
        for config in (SegmentationConfig(), torn)
    ]
    folded, apart = (table.pixels[:, 0] for table in tables)
    assert folded.max() > 0.97 * folded.sum()
    assert apart.max() < 0.9 * apart.sum()
