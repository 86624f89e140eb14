import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sound_tree import assert_sound

from nurbseg.common.settings import updated
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.evaluation.truth import Truth, ground_truth
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, register
from nurbseg.segmentation.vocabulary import StopReason

MANY_PIECES = SegmentationConfig(
    method="nurbseg",
    decimation=1,
    extended=ExtendedConfig(piece_pixels_min=1, refine_borders=False, merge_surfaces=False),
)
CONFIG = SegmentationConfig(method="nurbseg")
DATA = os.environ.get("NURBSEG_DATA", "")


@pytest.mark.parametrize("decimation", [1, 2])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_box_on_a_table_is_two_objects_of_four_surfaces(cloud_of, box_on_table, decimation, seed):
    depth, truth = box_on_table((480, 640), noise_per_m=1.5e-3, seed=seed)
    cloud = cloud_of(depth)
    tree = segment(cloud, replace(CONFIG, decimation=decimation, seed=seed))
    assert_sound(tree, cloud.valid)
    assert len(tree.objects) == 2
    assert Contingency.between(tree.labels(), np.minimum(truth, 2)).rand_index() > 0.998
    # A surface lies on one face, though a face may be more than one surface.
    for leaf in tree.leaves():
        on_face = np.bincount(truth.ravel()[leaf.pixels])
        assert on_face.max() > 0.95 * leaf.pixels.size
    assert StopReason.NOISE in {leaf.stop for leaf in tree.leaves()}


def test_an_image_of_half_the_size_is_decided_on_the_same_points(cloud_of, box_on_table):
    cloud = cloud_of(box_on_table((480, 640), noise_per_m=1.5e-3)[0])
    points_m, color, colored = (
        np.ascontiguousarray(each[::2, ::2]) for each in (cloud.points_m, cloud.color, cloud.colored)
    )
    whole, half = segment(cloud, CONFIG), segment(PointMap(points_m, color, colored), CONFIG)
    assert len(half.leaves()) > 3
    assert [each.name for each in half.segments] == [each.name for each in whole.segments]
    for each, same in zip(half.segments, whole.segments, strict=True):
        rows, columns = np.divmod(same.fit.pixels, 640)
        assert np.array_equal(each.fit.pixels, rows // 2 * 320 + columns // 2)
        assert each.fit.values == pytest.approx(same.fit.values, rel=1e-4)
    assert np.mean(half.labels() == whole.labels()[::2, ::2]) > 0.99


def test_the_level_says_what_a_label_is(cloud_of, box_on_table):
    depth, _ = box_on_table(noise_per_m=1.5e-3)
    cloud = cloud_of(depth)
    objects = segment(cloud, updated(CONFIG, extended={"level": "objects"}))
    surfaces = segment(cloud, updated(CONFIG, extended={"level": "surfaces"}))
    assert np.array_equal(objects.labels(), objects.labels("objects"))
    assert np.array_equal(surfaces.labels(), surfaces.labels("surfaces"))
    assert np.array_equal(surfaces.labels("surfaces"), objects.labels("surfaces"))
    assert objects.labels().max() < surfaces.labels().max()


@pytest.mark.parametrize(
    "off",
    [
        {"extended": {"normal_weight": 0.0}},
        {"extended": {"noise_floor": 0.0}},
        {"extended": {"cuts": 1}},
        {"extended": {"refine_borders": False}},
        {"extended": {"merge_surfaces": False}},
        {"metric": "mmxc"},
        {"extended": {"smoothness": 0.0}},
        {"splitting_point": "ncut"},
    ],
    ids=str,
)
def test_every_stage_can_be_switched_off(cloud_of, box_on_table, off):
    depth, _ = box_on_table(noise_per_m=1.5e-3)
    depth[np.random.default_rng(0).random(depth.shape) < 0.05] = np.nan
    cloud = cloud_of(depth)
    tree = segment(cloud, updated(CONFIG, **off))
    assert_sound(tree, cloud.valid)
    assert bool(tree.objects) == ("merge_surfaces" not in off.get("extended", {}))


@pytest.mark.parametrize("points", [0, 1, 2, 30])
def test_next_to_no_points_are_one_leaf(cloud_of, points):
    depth = np.full((60, 80), np.nan)
    depth.ravel()[np.random.default_rng(0).choice(depth.size, points, replace=False)] = 1.0
    cloud = cloud_of(depth)
    tree = segment(cloud, replace(CONFIG, decimation=1))
    assert len(tree.leaves()) == 1
    assert np.count_nonzero(tree.labels()) == points


def test_a_thousand_things_apart_in_depth_are_as_many_leaves(cloud_of):
    rows, columns = np.indices((140, 130)) // 4
    tree = segment(cloud_of(np.where((rows + columns) % 2 == 0, 1.0, 2.0)), MANY_PIECES)
    assert len(tree.leaves()) == 35 * 33
    assert tree.labels("surfaces").max() == 35 * 33
    assert {leaf.pixels.size for leaf in tree.leaves()} == {8, 16}


@pytest.mark.skipif(not (Path(DATA) / "mosd_learn").is_dir(), reason="needs mosd_learn in NURBSEG_DATA")
def test_real_tabletop_frames_are_segmented_well():
    options = SourceOptions(intrinsics=(525.0, 525.0, 319.5, 239.5))
    scores: dict[Truth, list[list[float]]] = {"labels": [], "joined": []}
    with open_source(str(Path(DATA) / "mosd_learn"), options) as source:
        for frame in source:
            if frame.index % 9 or frame.labels is None:
                continue
            labels = segment(register(frame), CONFIG).labels()
            for truth, own in scores.items():
                table = Contingency.between(labels, ground_truth(frame.labels, truth))
                own.append(
                    [
                        table.rand_index(),
                        table.region_covering(),
                        table.variation_of_information(),
                        table.object_iou(),
                    ]
                )
    for own in scores.values():
        ri, covering, voi, _ = np.mean(own, axis=0)
        assert ri > 0.995
        assert covering > 0.985
        assert voi < 0.07
    # By the labels, the inside of a bowl is another object than its outside: no method is right by both.
    assert np.mean(scores["joined"], axis=0)[3] > 0.9
