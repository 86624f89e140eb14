"""Objects of live frames: as those of a frame alone, and steady while evidence wavers."""

from collections.abc import Callable

import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.objects import merge
from nurbseg.segmentation.objects.pair_features import NODE, model_of
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree

CONFIG = SegmentationConfig()


@pytest.fixture
def box(cloud_of, box_on_table) -> PointMap:
    """A box on a table: four surfaces at least."""
    return cloud_of(box_on_table(noise_per_m=2e-3)[0])


@pytest.fixture
def wavering(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A function that sets the log odds of every border from now on."""

    def set_to(log_odds: float) -> None:
        leaf = np.array([(0, 0.0, -1, -1, log_odds)], dtype=NODE)
        monkeypatch.setattr(merge, "merging_model", lambda: model_of(leaf))

    return set_to


def is_one(tree: SegmentationTree) -> bool:
    """Whether all leaves are one object, of which there is one of each else."""
    assert len(tree.leaves()) > 3
    assert len(tree.objects) in (1, len(tree.leaves()))
    return len(tree.objects) == 1


@pytest.mark.parametrize("first", [0.3, -0.3])
def test_merges_do_not_flicker_with_evidence_that_wavers(box, wavering, first):
    live = LiveTree(CONFIG)
    for odds in [first, *np.random.default_rng(0).uniform(-0.8, 0.8, 30)]:
        wavering(odds)
        assert is_one(live.segment(box)) == (first > 0)


@pytest.mark.parametrize("first", [2.0, -2.0])
def test_clear_evidence_decides_at_once(box, wavering, first):
    live = LiveTree(CONFIG)
    for turn in range(6):
        odds = first if turn % 2 == 0 else -first
        wavering(odds)
        tree = live.segment(box)
        assert is_one(tree) == (odds > 0)
        # What was before counts nothing.
        assert {contact.log_odds for contact in tree.contacts} == {odds}
        assert {contact.evidence.get("kept", 0.0) for contact in tree.contacts} == {0.0}


def test_merges_change_when_evidence_does_for_good(box, wavering):
    live = LiveTree(CONFIG)
    wavering(0.9)
    assert is_one(live.segment(box))
    wavering(-0.9)
    # Weaker evidence than the hysteresis never parts them; stronger does, though no jump leads there.
    assert all(is_one(live.segment(box)) for _ in range(20))
    wavering(-1.9)
    assert not any(is_one(live.segment(box)) for _ in range(5))


def test_the_evidence_of_a_contact_is_that_of_its_frame_and_of_the_one_before(box, wavering):
    live = LiveTree(CONFIG)
    for odds, kept in ((0.5, 0.0), (0.0, 1.0), (0.4, 1.0)):
        wavering(odds)
        contacts = live.segment(box).contacts
        assert contacts
        for contact in contacts:
            assert contact.evidence.get("base", 0.0) == odds
            assert np.sign(contact.evidence.get("kept", 0.0)) == kept
            assert contact.log_odds == pytest.approx(sum(contact.evidence.values()))
            assert contact.merged == (contact.log_odds > 0)


def test_a_leaf_that_is_new_is_judged_without_what_was_before(box, wavering):
    live = LiveTree(CONFIG)
    wavering(0.9)
    known = live.segment(box)
    wavering(-0.9)
    # A thing 60 cm away, before the table.
    points_m, thing = box.points_m.copy(), np.s_[100:140, 20:60]
    points_m[thing] *= 0.6 / points_m[thing][..., 2:]
    tree = live.segment(PointMap(points_m, box.color, box.colored))
    assert (live.report.reset, live.report.appeared) == ("", 1)
    assert len(tree.leaves()) == len(known.leaves()) + 1
    (new,) = (leaf for leaf in tree.leaves() if 120 * 320 + 40 in leaf.pixels)
    beside = {contact.first for contact in tree.contacts} | {contact.second for contact in tree.contacts}
    assert new.name in beside
    for contact in tree.contacts:
        assert contact.merged == (new.name not in (contact.first, contact.second))
