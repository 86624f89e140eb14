import numpy as np
import pytest
from child_python import run_python
from sound_tree import assert_sound

from nurbseg.segmentation.config import SegmentationConfig, Stag15Config
from nurbseg.segmentation.methods import segment
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


@pytest.mark.parametrize("decimation", [1, 2, 3])
def test_a_step_comes_out_as_its_two_surfaces(cloud_of, decimation):
    cloud, truth = step_scene(cloud_of)
    tree = segment(cloud, stag15(decimation=decimation))
    labels = tree.labels("surfaces")
    assert_sound(tree, cloud.valid)
    assert len(tree.leaves()) == 2
    assert (labels == truth).all() or (labels == 3 - truth).all()
    assert {leaf.stop for leaf in tree.leaves()} == {StopReason.CRITERION}


def test_one_plane_stays_whole(cloud_of):
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    tree = segment(cloud_of(1.0 / (0.6 + 0.001 * rows - 0.0005 * columns)), stag15())
    assert [each.stop for each in tree.segments] == [StopReason.CRITERION]
    with pytest.raises(KeyError, match="no segment '01'"):
        tree["01"]


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


@pytest.mark.parametrize(
    ("where", "stop"),
    [
        ((slice(0), slice(0)), StopReason.NO_POINTS),
        ((slice(40, 44), slice(60, 64)), StopReason.TOO_SMALL),
        ((slice(41, 42), slice(61, 62)), StopReason.TOO_SMALL),
    ],
)
def test_fewer_points_than_the_limit_are_one_leaf(cloud_of, where, stop):
    depth = np.full(SIZE, np.nan)
    depth[where] = 1.0
    cloud = cloud_of(depth)
    tree = segment(cloud, stag15(decimation=2))
    (root,) = tree.segments
    assert root.stop is stop
    assert root.fit.reason == ("0 points, 1 needed" if stop is StopReason.NO_POINTS else "")
    assert ((tree.labels("surfaces") == 1) == cloud.valid).all()


def test_points_that_are_all_equal_are_one_leaf(cloud_of):
    cloud = cloud_of(np.ones(SIZE))
    tree = segment(type(cloud)(np.ones_like(cloud.points_m), cloud.color, cloud.colored), stag15())
    assert [each.stop for each in tree.segments] == [StopReason.CRITERION]


def test_a_constant_position_that_is_not_explained_has_no_cut(cloud_of):
    # Two mirror points in a checkerboard: no surface explains them, and vectors of lambda 0 are all equal.
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    cloud = cloud_of(1.0 + 0.1 * ((rows // 2 + columns // 2) % 2))
    tree = segment(cloud, stag15(geometry_weight=0.0))
    assert [each.stop for each in tree.segments] == [StopReason.NO_CUT]


def test_fewer_points_than_samples_can_be_split(cloud_of):
    cloud, truth = step_scene(cloud_of)
    small = type(cloud)(
        *(image[50:60, 80:90].copy() for image in (cloud.points_m, cloud.color, cloud.colored))
    )
    config = stag15(decimation=1, samples=2000, stag15=Stag15Config(segment_pixels_min=10_000))
    labels = segment(small, config).labels("surfaces")
    assert np.unique(labels - truth[50:60, 80:90].astype(np.uint16)).size == 1
