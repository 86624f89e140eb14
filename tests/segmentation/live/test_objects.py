"""Objects of live frames: as those of a frame alone, and steady while evidence wavers."""

import numpy as np
import pytest

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.extended.memory import LeafMemory
from nurbseg.segmentation.live.objects import ObjectMemory
from nurbseg.segmentation.objects import merge
from nurbseg.segmentation.objects.merge import merge_surfaces
from nurbseg.segmentation.objects.pair_features import NODE, model_of
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.surfaces.inverse_depth import fit_window
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
    leaves = [LeafMemory(0) for _ in NAMES]
    return grid, truth, on_grid, surfaces, leaves


def test_the_first_frame_is_merged_as_one_alone(box):
    grid, truth, _, surfaces, leaves = box
    table = SurfaceTable(surfaces)
    found = ObjectMemory().merged(leaves, NAMES, truth, table, grid, CONFIG)
    assert found == merge_surfaces(truth, grid, NAMES, table, CONFIG)
    assert len(found.contacts) > 2


@pytest.fixture
def wavering(monkeypatch):
    """A function that sets the log odds of every border from now on."""

    def set_to(log_odds):
        leaf = np.array([(0, 0.0, -1, -1, log_odds)], dtype=NODE)
        monkeypatch.setattr(merge, "merging_model", lambda: model_of(leaf))

    return set_to


def merged_now(memory, box, config=CONFIG):
    grid, truth, _, surfaces, leaves = box
    objects, contacts, _ = memory.merged(leaves, NAMES, truth, SurfaceTable(surfaces), grid, config)
    return len(objects) == 1, contacts


@pytest.mark.parametrize("first", [0.3, -0.3])
def test_merges_do_not_flicker_with_evidence_that_wavers(box, wavering, first):
    memory = ObjectMemory()
    for odds in [first, *np.random.default_rng(0).uniform(-0.8, 0.8, 60)]:
        wavering(odds)
        assert merged_now(memory, box)[0] == (first > 0)


@pytest.mark.parametrize("first", [2.0, -2.0])
def test_clear_evidence_decides_at_once(box, wavering, first):
    memory = ObjectMemory()
    for turn in range(6):
        odds = first if turn % 2 == 0 else -first
        wavering(odds)
        is_one, contacts = merged_now(memory, box)
        assert is_one == (odds > 0)
        # What was before counts nothing.
        assert {contact.log_odds for contact in contacts} == {odds}
        assert {contact.evidence.get("kept", 0.0) for contact in contacts} == {0.0}


def test_merges_change_when_evidence_does_for_good(box, wavering):
    memory = ObjectMemory()
    wavering(0.9)
    assert merged_now(memory, box)[0]
    wavering(-0.9)
    # Weaker evidence than the hysteresis never parts them; stronger does, though no jump leads there.
    assert all(merged_now(memory, box)[0] for _ in range(30))
    wavering(-1.9)
    assert not any(merged_now(memory, box)[0] for _ in range(20))


def test_the_evidence_of_a_contact_is_that_of_its_frame_and_of_the_one_before(box, wavering):
    memory = ObjectMemory()
    for odds, kept in ((0.5, 0.0), (0.0, 1.0), (0.4, 1.0)):
        wavering(odds)
        _, contacts = merged_now(memory, box)
        assert contacts
        for contact in contacts:
            assert contact.evidence.get("base", 0.0) == odds
            assert np.sign(contact.evidence.get("kept", 0.0)) == kept
            assert contact.log_odds == pytest.approx(sum(contact.evidence.values()))
            assert contact.merged == (contact.log_odds > 0)


def test_a_leaf_that_is_new_is_judged_without_what_was_before(box, wavering):
    memory = ObjectMemory()
    wavering(0.9)
    merged_now(memory, box)
    wavering(-0.9)
    *rest, leaves = box
    new = [*leaves[:3], LeafMemory(1)]
    _, contacts = merged_now(memory, (*rest, new))
    for contact in contacts:
        is_new = NAMES[3] in (contact.first, contact.second)
        assert contact.merged == (not is_new)


def test_merging_can_be_switched_off(box):
    off = SegmentationConfig(extended=ExtendedConfig(merge_surfaces=False))
    grid, truth, _, surfaces, leaves = box
    assert ObjectMemory().merged(leaves, NAMES, truth, SurfaceTable(surfaces), grid, off) == ((), (), ())
