import numpy as np
import pytest

from nurbseg.segmentation.labels.regions import joints
from nurbseg.segmentation.live.structure import Growth, Revised
from nurbseg.segmentation.segments import Node
from nurbseg.segmentation.surfaces.surface import Fit


def growth_of(labels):
    fit = Fit(None, np.zeros(0), {}, "", np.zeros(0, dtype=np.intp))
    root = Node("", np.zeros(0, dtype=np.intp), fit)
    # As many leaves as there are labels; none of them is asked for anything here.
    return Growth(root, [None] * int(labels.max()), labels, lambda node: None)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_pixels_with_the_label_of_their_place_change_with_it(step):
    rng = np.random.default_rng(step)
    h, w = 9, 13
    before = rng.integers(0, 4, (-(-h // step), -(-w // step))).astype(np.int32)
    after = rng.integers(0, 6, before.shape).astype(np.int32)
    labels = rng.integers(0, 4, (h, w)).astype(np.uint16)
    per_m = rng.choice([0.0, 0.8], (h, w)).astype(np.float32)
    labels[per_m == 0] = 0
    final = np.array([0, 3, 1, 2, 5, 4], dtype=np.uint16)
    found = Revised([], before, after, final).relabelled(labels, per_m, step)
    for r, c in np.ndindex(h, w):
        place = r // step, c // step
        number = after[place] if labels[r, c] == before[place] else labels[r, c]
        # What has no point gets no label, whatever becomes of the place that it is beside.
        assert found[r, c] == (final[number] if per_m[r, c] > 0 else 0)


def test_places_are_counted_by_number():
    labels = np.random.default_rng(0).integers(0, 7, (20, 30)).astype(np.int32)
    expected = np.bincount(labels.ravel(), minlength=int(labels.max()) + 1)
    expected[0] = 0
    assert (growth_of(labels).sizes() == expected).all()


@pytest.mark.parametrize("least", [1, 4, 9])
def test_neighbors_meet_along_so_many_joined_places(least):
    rng = np.random.default_rng(3)
    labels = rng.integers(0, 6, (24, 31)).astype(np.int32)
    joined = joints(rng.random(labels.shape).astype(np.float32), labels > 0, 0.4)
    counts = {}
    for ahead, behind, among in (
        (labels[:, :-1], labels[:, 1:], joined.right[:, :-1]),
        (labels[:-1], labels[1:], joined.down[:-1]),
    ):
        for one, other in zip(ahead[among].tolist(), behind[among].tolist(), strict=True):
            if one != other:
                pair = min(one, other), max(one, other)
                counts[pair] = counts.get(pair, 0) + 1
    expected = sorted(pair for pair, number in counts.items() if number >= least)
    assert growth_of(labels).neighbors(joined, least) == expected
