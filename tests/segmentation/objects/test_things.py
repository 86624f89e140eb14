"""Tests of things: objects that others cut apart on the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.common.settings import updated
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation import LiveTree, SegmentationConfig, segment
from nurbseg.segmentation.objects.merge import Contact, SceneObject
from nurbseg.segmentation.objects.things import join_objects
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.points.registration import PointMap, register
from nurbseg.segmentation.segments import SegmentationTree

NOISE_PER_M = 2.5e-3
CONFIG = SegmentationConfig()
THINGS = updated(CONFIG, extended={"level": "things"})
#: Columns of a post of 1 m distance before walls of about 2 m.
LEFT, RIGHT = 140, 180


@pytest.fixture
def walls(cloud_of: Callable[..., PointMap]) -> Callable[..., PointMap]:
    """A function that returns walls left and right of a post of 1 m distance, which may be told otherwise."""

    def build(
        right_m: float = 2.0,
        between_m: float = 1.0,
        right_color: int = 120,
        left: int = LEFT,
        *,
        round_m: float = 0.0,
        window_m: float = 0.0,
        seed: int = 0,
    ) -> PointMap:
        columns = np.broadcast_to(np.arange(320.0), (240, 320))
        depth_m = np.where(columns < left, 2.0, right_m)
        if round_m:
            # A quadric of inverse depth.
            depth_m = 1.0 / (1.0 / depth_m - (columns / 320.0 - 0.5) ** 2 * round_m)
        between = (columns >= left) & (columns < left + RIGHT - LEFT)
        depth_m = np.where(between, between_m, depth_m)
        if window_m:
            depth_m[80:140, left + 8 : left + 32] = window_m
        noise = np.random.default_rng(seed).normal(0.0, NOISE_PER_M / 2, depth_m.shape)
        color = np.full((240, 320, 3), 120, dtype=np.uint8)
        color[columns >= left + RIGHT - LEFT] = right_color
        color[between] = (200, 40, 40)
        return cloud_of(1.0 / (1.0 / depth_m + noise), color)

    return build


def sides(labels: NDArray[np.uint16]) -> tuple[int, int, int]:
    """Return the labels of the left wall, of what is between, and of the right wall."""
    return tuple(int(np.bincount(labels[:, c - 8 : c + 8].ravel()).argmax()) for c in (60, 160, 280))  # type: ignore[return-value]


def joined(tree: SegmentationTree) -> bool:
    left, between, right = sides(tree.labels("things"))
    assert between not in (left, right)
    assert (left == right) == bool(tree.joins)
    return left == right


@pytest.mark.parametrize("round_m", [0.0, 0.5])
def test_what_a_post_cuts_apart_is_one_thing(walls, round_m):
    cloud = walls(round_m=round_m)
    tree = segment(cloud, THINGS)
    assert joined(tree)
    (join,) = tree.joins
    assert {join.first, join.second} <= {leaf.name for leaf in tree.leaves()}
    assert join.ratio < 1.2 and join.nearer > 0.9 and join.color < 1.0

    left, _, right = sides(segment(cloud, CONFIG).labels("objects"))
    assert left != right


def test_what_is_unknown_between_them_is_not_farther(walls):
    # The same fifth as below, but without depth.
    assert joined(segment(walls(window_m=np.nan), THINGS))


def test_objects_are_joined_only_at_the_level_of_things(walls):
    tree = segment(walls(), CONFIG)
    assert tree.joins == ()
    assert np.array_equal(tree.labels("things"), tree.labels("objects"))


def test_without_objects_there_is_nothing_to_join(walls):
    tree = segment(walls(), updated(THINGS, extended={"merge_surfaces": False}))
    assert (tree.objects, tree.joins) == ((), ())
    assert np.array_equal(tree.labels(), tree.labels("surfaces"))


@pytest.mark.parametrize(
    "other",
    [
        {"right_m": 2.2},  # 0.045 1/m farther: 18 times the noise
        {"right_color": 230},
        {"between_m": 3.0},  # a gap through which something farther is seen
        {"between_m": np.nan},  # nothing is known to stand between
        {"window_m": 3.0},  # a fifth of what is between is farther
    ],
    ids=["another surface", "another color", "farther between", "nothing between", "partly farther"],
)
def test_what_one_surface_does_not_explain_stays_two(walls, other):
    tree = segment(walls(**other), THINGS)
    left, _, right = sides(tree.labels("things"))
    assert left != right
    assert tree.joins == ()


#: Columns of three walls of one plane, the labels 1 to 3, and of two posts between them, 4 and 5.
STRIPS = {1: (0, 60), 4: (60, 90), 2: (90, 230), 5: (230, 260), 3: (260, 320)}


@pytest.fixture
def strips(cloud_of: Callable[..., PointMap]) -> Callable[..., tuple[list[str], list[set[str]]]]:
    """A function that joins objects of strips, which are named by their labels; returns objects and joins."""

    def join(objects: Sequence[str], meet: Sequence[str] = ()) -> tuple[list[str], list[set[str]]]:
        depth_m, labels = np.full((240, 320), 2.0), np.zeros((240, 320), dtype=np.int32)
        for label, (left, right) in STRIPS.items():
            labels[:, left:right] = label
        depth_m[labels > 3] = 1.0
        cloud = cloud_of(depth_m)
        found, joins = join_objects(
            [SceneObject(tuple(each)) for each in objects],
            [Contact(first, second, False, 9, 9, -1.0, {}) for first, second in meet],
            labels,
            "12345",
            depth_grid(cloud, 1),
            cloud.color,
            THINGS,
        )
        return ["".join(each.leaves) for each in found], [{join.first, join.second} for join in joins]

    return join


def test_things_are_joined_in_turn_and_the_largest_comes_first(strips):
    found, joins = strips("12345")
    assert found == ["123", "4", "5"]
    assert len(joins) == 2


def test_what_is_one_thing_already_is_not_joined_again(cloud_of):
    # Three parts of a wall, each of which is one with both others, around a post.
    labels = np.full((240, 320), 4, dtype=np.int32)
    labels[90:150, :60], labels[:100, 90:], labels[140:, 90:] = 1, 2, 3
    # The second is a little nearer.
    cloud = cloud_of(np.choose(labels - 1, (2.0, 1 / 0.504, 2.0, 1.0)))
    grid, objects = depth_grid(cloud, 1), [SceneObject((name,)) for name in "1234"]

    def joined_names(contacts):
        things, joins = join_objects(objects, contacts, labels, "1234", grid, cloud.color, THINGS)
        return [thing.leaves for thing in things], [join.first + join.second for join in joins]

    for one, other, third in ("123", "132", "231"):
        meet = [Contact(each, third, False, 9, 9, -1.0, {}) for each in (one, other)]
        assert joined_names(meet)[1] == [one + other]
    things, joins = joined_names([])
    assert things == [("1", "2", "3"), ("4",)]
    # The smallest ratio first.
    assert joins == ["13", "23"]


def test_what_meets_is_decided_by_its_border(strips):
    found, joins = strips("12345", meet=["12"])
    assert found == ["23", "1", "4", "5"]
    assert joins == [{"2", "3"}]
    # Objects meet where any of their surfaces do.
    assert strips(["13", "2", "4", "5"], meet=["32"])[1] == []
    # Nor are objects that meet joined through a third.
    found, _ = strips("12345", meet=["13"])
    assert sorted(map(len, found)) == [1, 1, 1, 2]


def test_an_object_without_a_main_surface_is_not_compared(strips):
    assert strips(["13", "2", "4", "5"]) == (["123", "4", "5"], [{"1", "2"}])
    # Of 150 columns the largest surface has 60.
    assert strips(["135", "2", "4"])[1] == []


@pytest.mark.parametrize("rougher", [1, 2])
def test_the_ratio_is_the_larger_one_of_the_two_surfaces(cloud_of, rougher):
    """Planes left and right of a post, by NumPy's least squares."""
    rows, columns = np.mgrid[:16, :46]
    labels = np.where(columns < 18, 1, np.where(columns < 30, 3, 2)).astype(np.int32)
    noise = np.random.default_rng(rougher).standard_normal(labels.shape)
    inverse_depth = 0.5 + 1e-3 * columns + np.where(labels == rougher, 3e-3, 1.5e-3) * noise
    inverse_depth += 0.006 * (labels == 2) + 0.4 * (labels == 3)
    cloud = cloud_of(1.0 / inverse_depth)
    objects = [SceneObject((name,)) for name in "123"]
    found = join_objects(objects, [], labels, "123", depth_grid(cloud, 1), cloud.color, THINGS)[1]
    # Without the columns beside the post.
    sides = [
        (np.column_stack([rows[inner], columns[inner], np.ones(inner.sum())]), inverse_depth[inner])
        for inner in (columns < 17, columns > 30)
    ]
    # Each side has the same weight.
    weighed = (np.concatenate([side[n] / np.sqrt(len(side[1])) for side in sides]) for n in (0, 1))
    both = np.linalg.lstsq(*weighed, rcond=None)[0]
    alone = [np.linalg.lstsq(*side, rcond=None)[0] for side in sides]
    ratios = [
        np.linalg.norm(values - terms @ both) / np.linalg.norm(values - terms @ own)
        for (terms, values), own in zip(sides, alone, strict=True)
    ]
    assert [each.ratio for each in found] == [pytest.approx(max(ratios), abs=6e-4)]
    assert int(np.argmin(ratios)) == rougher - 1


def test_a_live_thing_stays_one_while_a_post_passes_and_it_is_shaded(walls):
    """With a difference in color of 36 walls stay one that are, and do not become one that are not."""
    live = LiveTree(THINGS)
    for frame in range(4):
        assert joined(live.segment(walls(left=LEFT + 2 * frame, seed=frame)))
    shaded = walls(left=LEFT + 6, right_color=215, seed=3)
    assert joined(live.segment(shaded))
    assert not joined(segment(shaded, THINGS))


def test_pieces_of_real_things_are_joined_and_hardly_any_others(real_data):
    right = []
    options = SourceOptions(intrinsics=(525.0, 525.0, 319.5, 239.5))
    with open_source(str(real_data("mosd_clutter")), options) as source:
        frames = list(source)
    for frame in frames:
        truth, tree = frame.labels, segment(register(frame), THINGS)
        image, names = tree.labels("surfaces"), [leaf.name for leaf in tree.leaves()]
        objects = {
            name: np.bincount(truth[image == label] // 10).argmax()
            for label, name in enumerate(names, start=1)
        }
        right += [objects[join.first] == objects[join.second] for join in tree.joins]
    assert len(right) > 20
    assert np.mean(right) >= 0.95
