from itertools import pairwise

import numpy as np
import pytest
from child_python import run_python
from numpy.testing import assert_allclose

from nurbseg.segmentation.config import SegmentationConfig, Stag15Config
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.fit import fit_surface
from nurbseg.segmentation.surfaces.metrics import METRICS, acceptance_ratio
from nurbseg.segmentation.vocabulary import StopReason

SIZE = (120, 160)


def stag15(**settings) -> SegmentationConfig:
    return SegmentationConfig(method="stag15", **settings)


def step_scene(cloud_of, noise_m: float = 0.0, far_m: float = 2.0, colors=((40, 90, 160), (200, 180, 60))):
    """Two flat things side by side, one at 1 m and one farther away: truth 1 and 2."""
    truth = np.ones(SIZE, dtype=int)
    truth[:, 85:] = 2
    depth = np.where(truth == 2, far_m, 1.0)
    rng = np.random.default_rng(0)
    return cloud_of(depth + noise_m * rng.normal(size=SIZE), np.array(colors)[truth - 1]), truth


def cluttered_scene(cloud_of, seed: int = 0):
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = 2.5 - 0.004 * rows
    color = np.full((*SIZE, 3), 90)
    for _ in range(7):
        row, column, radius = rng.integers(20, 100), rng.integers(20, 140), rng.integers(10, 25)
        inside = np.hypot(rows - row, columns - column) < radius
        bulge = np.sqrt(np.maximum(radius**2 - (rows - row) ** 2 - (columns - column) ** 2, 0)) * 0.01
        depth[inside] = (rng.uniform(1.0, 2.0) - bulge)[inside]
        color[inside] = rng.integers(0, 256, 3)
    depth += rng.normal(0, 0.002, SIZE)
    depth[rng.random(SIZE) < 0.02] = np.nan
    return cloud_of(depth, color)


def the_tree_is_sound(tree: SegmentationTree, valid) -> None:
    names = [each.name for each in tree.segments]
    assert names == sorted(names)
    assert len(set(names)) == len(names)
    for each in tree.segments:
        assert (each.stop is None) == bool(each.children)
        assert each.parent == (each.name[:-1] if each.name else None)
        if each.children:
            parts = [tree[name].pixels for name in each.children]
            assert (np.concatenate(parts) == each.pixels).all()
        else:
            assert (np.diff(each.pixels) > 0).all()
    labels = tree.labels("surfaces")
    assert labels.dtype == np.uint16
    assert ((labels > 0) == valid).all()
    for label, leaf in enumerate(tree.leaves(), start=1):
        assert (np.flatnonzero(labels == label) == leaf.pixels).all()


@pytest.mark.parametrize("decimation", [1, 2, 3])
def test_a_step_comes_out_as_its_two_surfaces(cloud_of, decimation):
    cloud, truth = step_scene(cloud_of)
    tree = segment(cloud, stag15(decimation=decimation))
    labels = tree.labels("surfaces")
    the_tree_is_sound(tree, cloud.valid)
    assert len(tree.leaves()) == 2
    assert (labels == truth).all() or (labels == 3 - truth).all()
    assert {leaf.stop for leaf in tree.leaves()} == {StopReason.CRITERION}


@pytest.mark.parametrize("metric", METRICS)
def test_every_metric_can_decide(cloud_of, metric):
    cloud = cluttered_scene(cloud_of)
    config = stag15(metric=metric, ratio_max=0.9)
    tree = segment(cloud, config)
    the_tree_is_sound(tree, cloud.valid)
    assert len(tree.leaves()) >= 2
    for each in tree.segments:
        assert metric in each.fit.values
        assert {"mse", "mae", "ve", "nle"} <= set(each.fit.values)
        if each.children:
            parts = [tree[name] for name in each.children]
            expected = acceptance_ratio(
                metric,
                *((part.fit.values[metric], part.fit.pixels.size) for part in (each, *parts)),
            )
            assert each.ratio == expected
            assert each.ratio < 0.9 or each.name == ""
        elif each.stop is StopReason.CRITERION:
            assert each.ratio is None or each.ratio >= 0.9


def test_one_plane_stays_whole(cloud_of):
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    cloud = cloud_of(1.0 / (0.6 + 0.001 * rows - 0.0005 * columns))
    tree = segment(cloud, stag15())
    assert [each.stop for each in tree.segments] == [StopReason.CRITERION]
    assert (tree.labels("surfaces") == 1).all()


def test_one_sphere_is_recovered(cloud_of):
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    ray = np.stack([(columns - 79.5) / 128, (rows - 59.5) / 128, np.ones(SIZE)], axis=-1)
    # A ball of 0.4 m at 2 m; what is not on its front is not there.
    a, b, c = (ray**2).sum(axis=-1), ray[..., 2] * 2.0, 4.0 - 0.16
    root = b**2 - a * c
    depth = np.where(root > 0.15, (b - np.sqrt(np.maximum(root, 0))) / a, np.nan)
    cloud = cloud_of(depth)
    fit = fit_surface(cloud, np.flatnonzero(cloud.valid), stag15())
    assert fit.residuals_m.max() < 1e-3
    tree = segment(cloud, stag15(ratio_max=0.5))
    assert len(tree.leaves()) <= 4
    assert fit.values["mse"] < 1e-7


def test_the_worst_segment_is_split_first(cloud_of):
    cloud = cluttered_scene(cloud_of)
    before: set[str] = set()
    for budget in range(1, 6):
        tree = segment(cloud, stag15(decimation=1, splits_max=budget))
        split = {each.name for each in tree.segments if each.children}
        assert len(split) == budget
        (latest,) = split - before
        waiting = [leaf for leaf in tree.leaves() if leaf.stop is StopReason.SPLITS]
        assert waiting
        for leaf in waiting:
            if leaf.parent != latest:
                assert leaf.fit.values["mse"] <= tree[latest].fit.values["mse"]
        before = split


def test_a_leaf_says_that_it_reached_the_depth(cloud_of):
    tree = segment(cluttered_scene(cloud_of), stag15(depth_max=2))
    assert StopReason.DEPTH in {leaf.stop for leaf in tree.leaves()}
    assert max(each.depth for each in tree.segments) == 2


def test_no_segment_is_smaller_than_the_limit(cloud_of):
    # The limit is in pixels of a 640x480 image; this one has a sixteenth of them.
    tree = segment(
        cluttered_scene(cloud_of), stag15(decimation=1, stag15=Stag15Config(segment_pixels_min=6400))
    )
    sizes = [leaf.pixels.size for leaf in tree.leaves()]
    assert min(sizes) >= 400
    small = [leaf for leaf in tree.leaves() if leaf.stop is StopReason.TOO_SMALL]
    assert all(leaf.pixels.size <= 800 for leaf in small)
    reasons = {leaf.stop for leaf in tree.leaves()}
    assert StopReason.CHILD_TOO_SMALL in reasons or StopReason.TOO_SMALL in reasons


def test_the_same_seed_gives_the_same_tree_and_another_seed_may_not(cloud_of):
    cloud = cluttered_scene(cloud_of)
    first, second, other = (segment(cloud, stag15(seed=seed)) for seed in (4, 4, 5))
    assert (first.labels("surfaces") == second.labels("surfaces")).all()
    assert [each.name for each in first.segments] == [each.name for each in second.segments]
    assert [each.ratio for each in first.segments] == [each.ratio for each in second.segments]
    assert (first.labels("surfaces") != other.labels("surfaces")).any()


_CHILD = """
import hashlib, sys
import numpy as np
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.methods import segment
loaded = np.load(sys.argv[1])
cloud = PointMap(loaded["points"], loaded["color"], np.ones(loaded["color"].shape[:2], dtype=bool))
for method, seed in (("stag15", 0), ("stag15", 1), ("nurbseg", 0)):
    tree = segment(cloud, SegmentationConfig(method=method, seed=seed))
    print(hashlib.sha256(tree.labels("surfaces").tobytes()).hexdigest())
    print([(s.name, str(s.stop), s.ratio and round(s.ratio, 9)) for s in tree.segments])
"""


def test_any_number_of_threads_gives_the_same_tree(cloud_of, tmp_path):
    cloud = cluttered_scene(cloud_of)
    scene = tmp_path / "scene.npz"
    points, color = (np.tile(image, (4, 4, 1)) for image in (cloud.points_m, cloud.color))
    np.savez(scene, points=points, color=color)
    outputs = set()
    for threads in ("1", "2", "4"):
        variables = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        environment = dict.fromkeys(variables, threads)
        outputs.add(run_python(_CHILD, str(scene), environment=environment).stdout)
    assert len(outputs) == 1
    assert len(next(iter(outputs)).splitlines()) == 6


def test_a_frame_without_depth_is_one_leaf_without_pixels(cloud_of):
    tree = segment(cloud_of(np.full(SIZE, np.nan)), stag15())
    (root,) = tree.segments
    assert root.stop is StopReason.NO_POINTS
    assert root.fit.surface is None
    assert root.fit.reason == "0 points, 1 needed"
    assert not tree.labels("surfaces").any()


@pytest.mark.parametrize("where", [(slice(40, 44), slice(60, 64)), (slice(41, 42), slice(61, 62))])
def test_fewer_points_than_the_limit_are_one_leaf(cloud_of, where):
    depth = np.full(SIZE, np.nan)
    depth[where] = 1.0
    cloud = cloud_of(depth)
    tree = segment(cloud, stag15())
    (root,) = tree.segments
    assert root.stop in (StopReason.TOO_SMALL, StopReason.NO_POINTS)
    assert ((tree.labels("surfaces") == 1) == cloud.valid).all()


def test_points_that_are_all_equal_are_one_leaf(cloud_of):
    cloud = cloud_of(np.ones(SIZE))
    points = np.ones_like(cloud.points_m)
    tree = segment(replace_points(cloud, points), stag15())
    assert [each.stop for each in tree.segments] == [StopReason.CRITERION]


def test_a_constant_position_that_is_not_explained_has_no_cut(cloud_of):
    # Two mirror points in a checkerboard: no surface explains them, and vectors of lambda 0 are all equal.
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    cloud = cloud_of(1.0 + 0.1 * ((rows // 2 + columns // 2) % 2))
    tree = segment(cloud, stag15(geometry_weight=0.0))
    assert [each.stop for each in tree.segments] == [StopReason.NO_CUT]


def replace_points(cloud, points):
    return type(cloud)(points, cloud.color, cloud.colored)


def test_a_constant_color_is_split_by_geometry(cloud_of):
    cloud, truth = step_scene(cloud_of, noise_m=0.001, far_m=5.0, colors=((0, 0, 0), (0, 0, 0)))
    labels = segment(cloud, stag15(ratio_max=0.8)).labels("surfaces")
    # No segment reaches over the step.
    for label in range(1, int(labels.max()) + 1):
        inside = truth[labels == label]
        assert max((inside == 1).mean(), (inside == 2).mean()) > 0.99


def test_fewer_points_than_samples_can_be_split(cloud_of):
    cloud, truth = step_scene(cloud_of)
    small = type(cloud)(
        *(image[50:60, 80:90].copy() for image in (cloud.points_m, cloud.color, cloud.colored))
    )
    config = stag15(decimation=1, samples=2000, stag15=Stag15Config(segment_pixels_min=10_000))
    labels = segment(small, config).labels("surfaces")
    assert np.unique(labels - truth[50:60, 80:90].astype(np.uint16)).size == 1


def test_the_first_split_is_kept_as_in_the_paper(cloud_of):
    cloud, _ = step_scene(cloud_of, noise_m=0.01)
    config = stag15(ratio_max=1e-6)
    kept = segment(cloud, config)
    assert len(kept.leaves()) == 2
    assert kept.root.ratio is not None
    assert kept.root.ratio > 1e-6


def test_the_grid_of_decision_does_not_move_the_border_of_clear_surfaces(cloud_of):
    cloud, _ = step_scene(cloud_of)
    images = [segment(cloud, stag15(decimation=step)).labels("surfaces") for step in (1, 2, 4)]
    for first, second in pairwise(images):
        assert (first == second).all() or (first == 3 - second).all()


def test_fits_name_the_pixels_they_were_made_on(cloud_of):
    cloud = cluttered_scene(cloud_of)
    tree = segment(cloud, stag15(decimation=2))
    for each in tree.segments:
        assert each.fit.pixels.size == each.fit.residuals_m.size
        assert cloud.valid.ravel()[each.fit.pixels].all()
        assert np.isin(each.fit.pixels, each.pixels).all()
        if each.fit.surface is not None:
            top, left, bottom, right = each.fit.surface.window
            # The fit was made on every second pixel; the window holds the others, too.
            rows, columns = np.divmod(each.pixels, SIZE[1])
            assert_allclose(
                [rows.min(), columns.min(), rows.max() + 1, columns.max() + 1], [top, left, bottom, right]
            )


def test_an_unknown_name_is_a_key_error(cloud_of):
    tree = segment(cloud_of(np.ones((9, 9))), stag15())
    with pytest.raises(KeyError, match="no segment '01'"):
        tree["01"]
