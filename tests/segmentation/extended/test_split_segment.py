"""One split of the default method: which cut is kept, what is told where none is, and what it falls into."""

from dataclasses import replace

import numpy as np
import pytest

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.cut.ncut import Cut
from nurbseg.segmentation.extended import splitting
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.parts import children_of
from nurbseg.segmentation.extended.splitting import _neighbors_side, split_segment
from nurbseg.segmentation.segments import Node, depth_first
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division, StopReason

SIZE = (48, 64)
#: 1/100 of the places of a 640x480 image: at most so many pixels make 20 places.
CONFIG = SegmentationConfig(
    method="nurbseg",
    decimation=1,
    ratio_max=0.5,
    extended=ExtendedConfig(piece_pixels_min=2000, inverse_depth_noise=1e-6, noise_floor=0.0, cuts=5),
)


@pytest.fixture
def roof(cloud_of) -> GridFeatures:
    """Two slopes that meet in a ridge down the middle, with some noise."""
    columns = np.mgrid[: SIZE[0], : SIZE[1]][1]
    inverse_depth = (
        0.9 - 0.01 * np.abs(columns - 31.5) + 1e-4 * np.random.default_rng(0).standard_normal(SIZE)
    )
    return grid_features(cloud_of(1.0 / inverse_depth), CONFIG)


ROWS, COLUMNS = np.mgrid[: SIZE[0], : SIZE[1]]
#: Which places are on the True side of a cut, and for none the reason.
SIDES = {
    "none": "nothing tells the points apart",
    "small": (ROWS < 3) & (COLUMNS < 6),
    "across": ROWS < 24,
    "aside": COLUMNS < 12,
    "ridge": COLUMNS < 32,
}


@pytest.mark.parametrize(
    ("cuts", "tried", "stop"),
    [
        ([], None, StopReason.NO_CUT),
        (["none"], None, StopReason.NO_CUT),
        (["small"], None, StopReason.CHILD_TOO_SMALL),
        (["small", "none"], None, StopReason.CHILD_TOO_SMALL),
        (["across"], "across", StopReason.CRITERION),
        (["across", "small"], "across", StopReason.CRITERION),
        (["across", "none"], "across", StopReason.CRITERION),
        (["aside", "across"], "aside", StopReason.CRITERION),
        (["across", "aside"], "aside", StopReason.CRITERION),
        (["ridge"], "ridge", None),
        (["none", "small", "aside", "across", "ridge", "across"], "ridge", None),
    ],
    ids=str,
)
def test_cuts_are_tried_in_turn_until_the_ratio_keeps_one(roof, monkeypatch, cuts, tried, stop):
    asked = []

    def scripted(vectors, *, count, **_):
        assert count == CONFIG.extended.cuts
        for name in cuts:
            asked.append(name)
            side = SIDES[name]
            where, reason = (np.zeros(SIZE, bool), side) if isinstance(side, str) else (side, "")
            yield Cut(where.ravel(), vectors[:1], np.zeros(1, np.float32), 0.7, reason)

    monkeypatch.setattr(splitting, "normalized_cuts", scripted)
    places = np.arange(ROWS.size)
    fit = splitting.fit_segment(roof, places, CONFIG).fit
    node = Node("01", places, fit, stop=StopReason.SPLITS)
    monkeypatch.setattr(splitting, "_MANY_PIXELS", ROWS.size + 1)
    split_segment(roof, node, CONFIG)
    assert asked == (cuts if stop is not None else cuts[: cuts.index("ridge") + 1])
    if tried is None:
        assert node.trial is None
    else:
        halves = [np.flatnonzero(SIDES[tried].ravel() == value) for value in (False, True)]
        found = [splitting.fit_segment(roof, half, CONFIG).fit for half in halves]
        assert sorted(node.trial.parts) == sorted((each.values["mse"], each.pixels.size) for each in found)
        assert (node.trial.value, node.trial.points) == (fit.values["mse"], ROWS.size)
        assert node.trial.kept == (stop is None)
    if stop is None:
        assert (node.stop, node.division) == (None, Division.CUT)
        assert np.array_equal(node.cut.side, SIDES["ridge"].ravel())
        for value, child in enumerate(node.children):
            assert (child.name, child.cuts_above) == (f"01{value}", 1)
            assert np.array_equal(child.grid_pixels, np.flatnonzero(SIDES["ridge"].ravel() == value))
    else:
        assert node.stop is stop
        assert (node.children, node.division, node.cut) == ((), None, None)


@pytest.mark.parametrize(
    ("cuts", "floors", "deviations", "asked"),
    [
        (3, 3.1, 2.3, 4),
        (3, 2.9, 2.3, 3),
        (3, 3.1, 2.1, 3),
        (3, np.inf, 2.3, 3),
        (1, 3.1, 2.3, 1),
        (2, 30.0, 9.0, 3),
    ],
)
def test_one_more_cut_is_asked_for_where_noise_explains_little_of_the_error(
    roof, monkeypatch, cuts, floors, deviations, asked
):
    counts = []
    monkeypatch.setattr(splitting, "normalized_cuts", lambda *_, count, **__: counts.append(count) or ())
    fit = splitting.fit_segment(roof, np.arange(ROWS.size), CONFIG).fit
    rms_per_m = deviations * CONFIG.extended.inverse_depth_noise
    node = Node("", np.arange(ROWS.size), replace(fit, floor=fit.values["mse"] / floors, rms_per_m=rms_per_m))
    split_segment(roof, node, updated(CONFIG, extended={"cuts": cuts}))
    assert counts == [asked]


def test_pieces_of_one_side_of_a_cut_have_no_cut_between_them(roof, monkeypatch):
    # Pixels of a diagonal are not connected: their neighbors take them over.
    side = (COLUMNS == ROWS + 8).ravel()
    monkeypatch.setattr(
        splitting,
        "normalized_cuts",
        lambda vectors, **_: [Cut(side, vectors[:1], np.zeros(1, np.float32), 0.7)],
    )
    monkeypatch.setattr(splitting, "_MANY_PIXELS", ROWS.size + 1)
    node = Node("", np.arange(ROWS.size), splitting.fit_segment(roof, np.arange(ROWS.size), CONFIG).fit)
    split_segment(roof, node, updated(CONFIG, ratio_max=2.0))
    assert (node.division, node.cut) == (Division.CUT, None)
    assert sum(child.grid_pixels.size for child in node.children) == ROWS.size


def part(first: int, places: int, stop: StopReason | None = None):
    own = np.arange(first, first + places)
    return Node("", own, Fit(None, np.zeros(0), {}, "", 3 * own), stop=stop)


def test_components_are_chained_the_largest_first():
    parent = Node("1", np.arange(24), part(0, 24).fit, cuts_above=2)
    small, largest, middle = part(0, 5), part(5, 9), part(14, 7, StopReason.NOISE)
    other = part(21, 3, StopReason.NO_POINTS)
    both = children_of(parent, ([small, largest, middle], [other]))
    nodes = {node.name: node for top in both for node in depth_first(top)}
    sizes = {name: node.grid_pixels.size for name, node in nodes.items()}
    assert sizes == {"10": 21, "100": 9, "101": 12, "1010": 7, "1011": 5, "11": 3}
    assert {node.cuts_above for node in nodes.values()} == {3}
    for name, node in nodes.items():
        apart = name in ("10", "101")
        assert node.division is (Division.GAP if apart else None)
        assert [child.name for child in node.children] == ([f"{name}0", f"{name}1"] if apart else [])
        assert np.array_equal(node.grid_pixels * 3, node.fit.pixels)
        assert (np.diff(node.grid_pixels) > 0).all()
    assert nodes["1010"].stop is StopReason.NOISE
    assert nodes["11"].stop is StopReason.NO_POINTS
    assert "3 components" in nodes["10"].fit.reason
    assert "2 components" in nodes["101"].fit.reason


@pytest.mark.parametrize("empty", [0, 1])
def test_pieces_of_the_one_side_that_is_left_are_the_largest_and_the_rest(empty):
    parent = Node("", np.arange(21), part(0, 21).fit)
    left = [part(0, 5), part(5, 9), part(14, 7)]
    first, second = children_of(parent, ([], left) if empty == 0 else (left, []))
    assert (first.name, first.grid_pixels.size, first.cuts_above) == ("0", 9, 1)
    assert [(child.name, child.grid_pixels.size) for child in second.children] == [("10", 7), ("11", 5)]


@pytest.mark.parametrize("seed", range(4))
def test_places_between_those_that_are_cut_follow_them_where_they_agree(seed):
    rng = np.random.default_rng(seed)
    height, width = (9, 12) if seed % 2 else (8, 11)
    places = np.flatnonzero(rng.random(height * width) < 0.8)
    drawn = np.array([p for p in places if p // width % 2 == 0 and p % width % 2 == 0])
    side = rng.random(drawn.size) < 0.5
    at = {(p // width, p % width): bool(s) for p, s in zip(drawn, side, strict=True)}
    found, asked = _neighbors_side(side, drawn, places, height, width)
    expected_asked = []
    for n, place in enumerate(places):
        row, column = place // width // 2 * 2, place % width // 2 * 2
        around = {at[r, c] for r in (row, row + 2) for c in (column, column + 2) if (r, c) in at}
        if len(around) == 1:
            assert found[n] == around.pop()
        else:
            expected_asked.append(n)
    assert asked.tolist() == expected_asked
    assert 0 < len(expected_asked) < places.size


def test_a_large_segment_is_cut_at_every_second_place_and_continued(roof, monkeypatch):
    node = Node("", np.arange(ROWS.size), splitting.fit_segment(roof, np.arange(ROWS.size), CONFIG).fit)
    monkeypatch.setattr(splitting, "_MANY_PIXELS", ROWS.size)
    split_segment(roof, node, CONFIG)
    assert node.cut.side.size == ROWS.size // 4
    # Whole sides, and the ridge where it is.
    for child, expected in zip(node.children, (COLUMNS < 32, COLUMNS >= 32), strict=True):
        share = np.mean(expected.ravel()[child.grid_pixels])
        assert max(share, 1 - share) > 0.98
    assert sum(child.grid_pixels.size for child in node.children) == ROWS.size
    monkeypatch.setattr(splitting, "_MANY_PIXELS", ROWS.size + 1)
    split_segment(roof, node, CONFIG)
    assert node.cut.side.size == ROWS.size
