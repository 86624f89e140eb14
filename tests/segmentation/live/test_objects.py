"""Objects of live frames: as those of a frame alone, and steady while evidence wavers."""

from itertools import combinations

import numpy as np
import pytest

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.extended.evidence import ITEMS
from nurbseg.segmentation.extended.merge import merge_surfaces
from nurbseg.segmentation.live import objects as live_objects
from nurbseg.segmentation.live.leaf import LiveLeaf
from nurbseg.segmentation.live.objects import ObjectMemory
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.segments import Node
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.inverse_depth import fit_window
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

CONFIG = SegmentationConfig()
NAMES = ("00", "01", "10", "11")


@pytest.fixture
def box(cloud_of, box_on_table):
    """A box on a table: the grid, labels on all pixels and on the grid, the surfaces, and live leaves."""
    depth, truth = box_on_table(noise_per_m=2e-3)
    grid = depth_grid(cloud_of(depth), 2)
    on_grid = np.ascontiguousarray(truth[::2, ::2])
    surfaces = []
    for label in range(1, 5):
        places = np.flatnonzero(on_grid == label)
        top, left, bottom, right = window = grid.window_mask(places)[0]
        mask = (on_grid == label)[top:bottom, left:right]
        surfaces.append(fit_window(grid, window, mask, CONFIG).surface)
    nothing = np.zeros(0, dtype=np.intp)
    leaves = [
        LiveLeaf(Node(name, nothing, Fit(surface, np.zeros(0), {}, "", nothing)))
        for name, surface in zip(NAMES, surfaces, strict=True)
    ]
    return grid, truth, on_grid, surfaces, leaves


def test_the_first_frame_is_merged_as_one_alone(box):
    grid, truth, on_grid, surfaces, leaves = box
    objects, contacts = ObjectMemory().merged(leaves, on_grid, SurfaceLattice(surfaces, 2), grid, CONFIG)
    alone, of_alone = merge_surfaces(truth, grid, NAMES, SurfaceTable(surfaces), CONFIG)
    assert objects == alone
    # Borders between places of the grid are nearly those between pixels.
    for live, cold in zip(contacts, of_alone, strict=True):
        assert (live.first, live.second, live.merged) == (cold.first, cold.second, cold.merged)
        assert live.log_odds == pytest.approx(cold.log_odds, abs=1.0)
        assert live.samples == pytest.approx(cold.samples, rel=0.1)
        assert "kept" not in live.evidence


@pytest.fixture
def wavering(monkeypatch):
    """A function that sets the log odds of every border from now on."""

    def set_to(log_odds):
        monkeypatch.setattr(
            live_objects,
            "evidence",
            lambda borders, *_: np.eye(1, len(ITEMS)) * log_odds * np.ones((len(borders.labels), 1)),
        )

    return set_to


def merged_now(memory, box, config=CONFIG):
    grid, _, on_grid, surfaces, leaves = box
    objects, contacts = memory.merged(leaves, on_grid, SurfaceLattice(surfaces, 2), grid, config)
    return len(objects) == 1, contacts


def test_merges_do_not_flicker_with_evidence_that_wavers(box, wavering):
    memory, seen = ObjectMemory(), []
    rng = np.random.default_rng(0)
    wavering(0.3)
    for odds in [0.3, *rng.uniform(-0.8, 0.8, 60)]:
        wavering(odds)
        seen.append(merged_now(memory, box)[0])
    assert all(seen)
    # The same, after what parted them.
    memory = ObjectMemory()
    for odds in [-0.3, *rng.uniform(-0.8, 0.8, 60)]:
        wavering(odds)
        assert not merged_now(memory, box)[0]


def test_merges_change_when_evidence_does_for_good(box, wavering):
    memory = ObjectMemory()
    wavering(2.0)
    assert merged_now(memory, box)[0]
    wavering(-2.0)
    seen = [merged_now(memory, box)[0] for _ in range(12)]
    # After n frames, 2 - 4 (1 - 0.8^n) is left of the 2: less than -0.5 from the fifth on.
    assert seen == [True] * 4 + [False] * 8


def test_evidence_adds_up_to_the_log_odds(box, wavering):
    memory = ObjectMemory()
    wavering(1.0)
    merged_now(memory, box)
    wavering(0.0)
    _, contacts = merged_now(memory, box)
    for contact in contacts:
        assert contact.evidence == {"base": 0.8, "kept": 0.5}
        assert contact.log_odds == pytest.approx(1.3)
    assert memory.same_object == {frozenset(pair) for pair in combinations(box[-1], 2)}


def test_samples_and_evidence_are_filtered_and_rounded(box, wavering):
    grid, truth, on_grid, surfaces, leaves = box
    shorter = on_grid.copy()
    shorter[: on_grid.shape[0] // 2] = 0
    memory = ObjectMemory()
    wavering(1.0)
    before = {(each.first, each.second): each for each in merged_now(memory, box)[1]}
    wavering(0.998)
    cut = grid, truth, shorter, surfaces, leaves
    exact = []
    for found, now in zip(merged_now(memory, cut)[1], merged_now(ObjectMemory(), cut)[1], strict=True):
        own = before[found.first, found.second]
        exact += [0.8 * own.samples + 0.2 * now.samples, 0.8 * own.touching + 0.2 * now.touching]
        assert [found.samples, found.touching] == [round(each) for each in exact[-2:]]
        assert found.evidence["base"] == 1.0
    assert any(round(each) > each for each in exact)


def test_a_pair_that_does_not_meet_any_more_is_no_object_now(box, wavering):
    memory = ObjectMemory()
    wavering(1.0)
    merged_now(memory, box)
    grid, truth, on_grid, surfaces, leaves = box
    merged_now(memory, (grid, truth, np.where(on_grid == 4, 0, on_grid), surfaces, leaves))
    assert memory.same_object == {frozenset(pair) for pair in combinations(leaves[:3], 2)}


def test_limits_are_eased_only_for_leaves_that_are_still_there(box, monkeypatch):
    grid, _, on_grid, _, leaves = box
    given = []
    monkeypatch.setattr(live_objects, "join_objects", lambda *_, kept: given.append(list(kept)) or ((), ()))
    memory = ObjectMemory()
    # A leaf that is gone may have had the name of one that is there.
    gone = LiveLeaf(leaves[3].node)
    for pair in ((leaves[0], leaves[3]), (leaves[0], gone)):
        memory._joined = {frozenset(pair)}
        memory.joined((), (), leaves, on_grid, grid, np.zeros((1, 1, 3), np.uint8), CONFIG)
    assert given == [[frozenset((NAMES[0], NAMES[3]))], []]


def test_merging_can_be_switched_off(box):
    grid, _, on_grid, surfaces, leaves = box
    off = SegmentationConfig(extended=ExtendedConfig(merge_surfaces=False))
    found = ObjectMemory().merged(leaves, on_grid, SurfaceLattice(surfaces, 2), grid, off)
    assert found == ((), ())
