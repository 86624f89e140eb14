"""How the tree grows: every tree is foretold from that without limits, whose values are computed by SciPy."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from exact_surface import metric as exact_metric
from exact_surface import ratio as exact_ratio

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import ExtendedConfig, Metric, SegmentationConfig, Stag15Config
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.metrics import METRICS
from nurbseg.segmentation.vocabulary import Division, StopReason

SIZE = (96, 128)
#: Places of the smallest segment: the limit is in pixels of a 640x480 image.
PLACES_MIN = 60
_PIXELS_MIN = PLACES_MIN * 640 * 480 // (SIZE[0] * SIZE[1])
LIMITLESS = {"ratio_max": 1e9, "depth_max": 64, "splits_max": 10_000}
PAPER = SegmentationConfig(
    method="stag15",
    decimation=1,
    samples=60,
    large_error_m=0.02,
    stag15=Stag15Config(segment_pixels_min=_PIXELS_MIN),
)
#: With no floor of noise, by the second eigenvector alone, and as the tree has grown.
EXTENDED = SegmentationConfig(
    method="nurbseg",
    decimation=1,
    samples=60,
    large_error_m=0.02,
    extended=ExtendedConfig(
        piece_pixels_min=_PIXELS_MIN,
        inverse_depth_noise=1e-6,
        noise_floor=0.0,
        cuts=1,
        fold_surfaces=False,
        protrusion_min=0.0,
        refine_borders=False,
    ),
)


@pytest.fixture
def clutter(cloud_of) -> PointMap:
    """Balls and slanted discs, some on a wavy wall and some before it, with some noise and some holes."""
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = 1.6 - 0.003 * rows + 0.02 * np.sin(columns / 7.0)
    color = np.full((*SIZE, 3), 90)
    for number in range(14):
        row, column, radius = rng.integers(8, 88), rng.integers(8, 120), rng.integers(7, 20)
        square = (rows - row) ** 2 + (columns - column) ** 2
        bulge = np.sqrt(np.maximum(radius**2 - square, 0)) * rng.choice([0.0, 0.012])
        slant = 0.01 * rng.normal() * (rows - row)
        before = rng.uniform(1.0, 1.5) if number % 2 else depth[row, column] - 0.02
        depth[square < radius**2] = (before + slant - bulge)[square < radius**2]
        color[square < radius**2] = rng.integers(0, 256, 3)
    depth += rng.normal(0, 0.001, SIZE) * depth
    depth[rng.random(SIZE) < 0.02] = np.nan
    return cloud_of(depth, color)


class Free:
    """A tree without limits, the exact value of its segments, and the exact ratio of its splits."""

    def __init__(self, cloud: PointMap, config: SegmentationConfig) -> None:
        self.tree = segment(cloud, replace(config, **LIMITLESS))
        self.values, self.ratios = {}, {}
        for each in self.tree.segments:
            if each.fit.surface is not None:
                self.values[each.name] = exact_metric(config.metric, each.fit, cloud, config)
        for each in self.tree.segments:
            if each.division is Division.CUT:
                measured = [(self.values[one.name], one.fit.pixels.size) for one in (each, *self.parts(each))]
                self.ratios[each.name] = exact_ratio(config.metric, *measured)

    def pieces(self, top: Segment) -> list[Segment]:
        """What is held together only because it is not connected."""
        if top.division is not Division.GAP:
            return [top]
        return [piece for name in top.children for piece in self.pieces(self.tree[name])]

    def parts(self, top: Segment) -> list[Segment]:
        """The pieces of both sides of a cut."""
        return [piece for name in top.children for piece in self.pieces(self.tree[name])]


def foretold(
    free: Free, config: SegmentationConfig, cuts_in_time: float = np.inf
) -> tuple[list[str], dict[str, StopReason]]:
    """Grow the tree of section 3.3 again, of the parts of one without limits: its splits, and why it ends."""
    cuts = 0
    split: list[str] = []
    stops: dict[str, StopReason] = {}
    waiting = [(-free.values[piece.name], piece.name, 0) for piece in free.pieces(free.tree.root)]
    while waiting:
        _, name, depth = here = min(waiting)
        waiting.remove(here)
        segment_here = free.tree[name]
        if segment_here.fit.pixels.size <= 2 * PLACES_MIN:
            stops[name] = StopReason.TOO_SMALL
        elif depth >= config.depth_max:
            stops[name] = StopReason.DEPTH
        elif len(split) >= config.splits_max:
            stops[name] = StopReason.SPLITS
        elif (cuts := cuts + 1) > cuts_in_time:
            stops[name] = StopReason.BUDGET
        elif name not in free.ratios:
            assert segment_here.stop is not None
            stops[name] = segment_here.stop
        elif free.ratios[name] < config.ratio_max or (config.method == "stag15" and name == ""):
            split.append(name)
            waiting += [(-free.values[part.name], part.name, depth + 1) for part in free.parts(segment_here)]
        else:
            stops[name] = StopReason.CRITERION
    return split, stops


def is_as_foretold(
    tree: SegmentationTree, free: Free, config: SegmentationConfig, cuts_in_time: float = np.inf
) -> bool:
    """Whether a tree has the splits, the stop reasons, the values and the ratios that it must have."""
    split, stops = foretold(free, config, cuts_in_time)
    assert {each.name for each in tree.segments if each.division is Division.CUT} == set(split)
    assert {leaf.name: leaf.stop for leaf in tree.leaves()} == stops
    # Decided on every pixel, with no border refined, a leaf has the pixels that were fitted.
    labels = tree.labels("surfaces")
    for label, leaf in enumerate(tree.leaves(), start=1):
        assert np.array_equal(np.flatnonzero(labels == label), leaf.fit.pixels)
    for each in tree.segments:
        if each.fit.surface is not None:
            expected = free.values[each.name]
            assert each.fit.values[config.metric] == pytest.approx(expected, rel=2e-3, abs=1e-9)
        if each.trial is not None:
            assert each.ratio == pytest.approx(free.ratios[each.name], rel=2e-3)
            assert each.trial.kept == bool(each.children)
    return True


both_methods = pytest.mark.parametrize("base", [PAPER, EXTENDED], ids=["stag15", "nurbseg"])


@both_methods
def test_cuts_have_as_many_landmarks_as_are_set(clutter: PointMap, base: SegmentationConfig) -> None:
    for landmarks in (20, 30):
        tree = segment(clutter, replace(base, landmarks=landmarks, splits_max=1))
        cuts = [each.cut for each in tree.segments if each.cut is not None]
        assert [cut.landmarks.shape[0] for cut in cuts] == [landmarks]


@both_methods
def test_thresholds_limits_and_order_are_those_of_the_paper(
    clutter: PointMap, base: SegmentationConfig
) -> None:
    free, reasons = Free(clutter, base), set()
    assert min(each.fit.pixels.size for each in free.tree.segments) >= PLACES_MIN
    for limits in (
        {"ratio_max": 1.0},
        {"ratio_max": 0.6},
        {"depth_max": 0},
        {"depth_max": 3},
        {"splits_max": 0},
        {"splits_max": 1},
        {"splits_max": 5},
        {"ratio_max": 0.8, "depth_max": 4, "splits_max": 6},
    ):
        config = replace(base, **{**LIMITLESS, **limits})
        tree = segment(clutter, config)
        assert is_as_foretold(tree, free, config)
        reasons |= {leaf.stop for leaf in tree.leaves()}
        if len(limits) == 1:
            cuts = sum(each.division is Division.CUT for each in tree.segments)
            assert cuts == limits.get("splits_max", cuts)
    assert reasons >= {StopReason.TOO_SMALL, StopReason.DEPTH, StopReason.SPLITS, StopReason.CRITERION}


@both_methods
@pytest.mark.parametrize("cuts_in_time", [0, 1, 4, 9])
def test_a_budget_of_time_ends_a_tree_where_it_is(
    clutter: PointMap, base: SegmentationConfig, cuts_in_time: int
) -> None:
    free = Free(clutter, replace(base, ratio_max=1.0))
    # A second goes by before each cut; the first is that of the start.
    config = replace(base, **LIMITLESS, budget_ms=1e3 * cuts_in_time + 500.0)
    tree = segment(clutter, config, clock=count().__next__)
    assert is_as_foretold(tree, free, config, cuts_in_time)
    assert StopReason.BUDGET in {leaf.stop for leaf in tree.leaves()}


@both_methods
@pytest.mark.parametrize("metric", METRICS)
def test_every_metric_decides_by_its_own_values(
    clutter: PointMap, base: SegmentationConfig, metric: Metric
) -> None:
    free = Free(clutter, replace(base, metric=metric))
    # Between two ratios, so that rounding does not decide.
    ascending = sorted(ratio for name, ratio in free.ratios.items() if name)
    middle = len(ascending) // 2
    config = replace(base, metric=metric, ratio_max=sum(ascending[middle - 1 : middle + 1]) / 2)
    tree = segment(clutter, replace(config, depth_max=64))
    assert is_as_foretold(tree, free, replace(config, depth_max=64))
    assert any(leaf.stop is StopReason.CRITERION and leaf.trial is not None for leaf in tree.leaves())


@both_methods
def test_only_the_paper_splits_a_frame_whose_metric_is_zero(cloud_of, base: SegmentationConfig) -> None:
    # No error is large, but the mean square is not 0: the paper keeps the first split all the same.
    tree = segment(two_colors(cloud_of, 100, 190), replace(base, metric="nle"))
    assert tree.root.fit.values["nle"] == 0 < tree.root.fit.values["mse"]
    assert (tree.root.trial is not None) == (len(tree.leaves()) == 2) == (base.method == "stag15")


def two_colors(cloud_of, left: int, right: int, apart: int = 0) -> PointMap:
    """Ten rows of a rough wall, so many places of one color and so many of another, perhaps apart."""
    rng = np.random.default_rng(0)
    depth, color = np.full(SIZE, np.nan), np.zeros((*SIZE, 3))
    for first, places, paint in ((20, left, (200, 40, 40)), (30 + apart, right, (40, 60, 200))):
        there = first + np.arange(places) // 10 + SIZE[1] * (40 + np.arange(places) % 10)
        depth.ravel()[there] = 1.0 + 0.002 * rng.standard_normal(places)
        color.reshape(-1, 3)[there] = paint
    return cloud_of(depth, color)


@both_methods
@pytest.mark.parametrize(
    ("left", "right", "grid_pixels_min", "reasons"),
    [
        # A side of exactly the limit is enough, twice the limit is not: |P| <= 2 T_p stops.
        (100, 101, 100, [StopReason.TOO_SMALL, StopReason.TOO_SMALL]),
        (100, 100, 100, [StopReason.TOO_SMALL]),
        (100, 101, 101, [StopReason.TOO_SMALL]),
        (100, 103, 101, [StopReason.CHILD_TOO_SMALL]),
        (100, 250, 101, [StopReason.CHILD_TOO_SMALL]),
    ],
)
def test_the_smallest_segment_has_exactly_t_p_places(cloud_of, base, left, right, grid_pixels_min, reasons):
    pixels_min = grid_pixels_min * 25
    config = updated(
        base,
        **LIMITLESS,
        stag15={"segment_pixels_min": pixels_min},
        extended={"piece_pixels_min": pixels_min, "color_weight": 1.0, "normal_weight": 0.0},
    )
    tree = segment(two_colors(cloud_of, left, right), config)
    assert [leaf.stop for leaf in tree.leaves()] == reasons
    if len(reasons) == 2:
        assert {leaf.fit.pixels.size for leaf in tree.leaves()} == {left, right}


@pytest.mark.parametrize(("grid_pixels_min", "leaves"), [(100, 2), (101, 1)])
def test_t_p_applies_to_a_side_apart_from_the_other_too(cloud_of, grid_pixels_min, leaves):
    # It touches nothing that it could be given to.
    tree = segment(
        two_colors(cloud_of, 100, 190, apart=2),
        updated(PAPER, stag15={"segment_pixels_min": grid_pixels_min * 25}),
    )
    assert len(tree.leaves()) == leaves
    assert (tree.root.stop is StopReason.CHILD_TOO_SMALL) == (leaves == 1)
