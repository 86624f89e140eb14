import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nurbseg.evaluation.scoring.regions import Contingency, boundary_scores


@st.composite
def label_pairs(draw):
    shape = draw(st.tuples(st.integers(1, 20), st.integers(2, 20)))
    maps = []
    for _ in range(2):
        most = draw(st.integers(1, 12))
        maps.append(draw(arrays.arrays(np.uint16, shape, elements=st.integers(0, most))))
    labels, truth = maps
    labels[0, :2], truth[0, :2] = 1, 1
    return labels, truth


def both_labelled(labels, truth):
    both = (labels > 0) & (truth > 0)
    return labels[both], truth[both]


def direct_overlaps(labels, truth):
    labels, truth = both_labelled(labels, truth)
    regions = []
    for region in np.unique(truth):
        best = 0.0
        for segment in np.unique(labels):
            common = np.sum((truth == region) & (labels == segment))
            best = max(best, common / np.sum((truth == region) | (labels == segment)))
        regions.append((np.sum(truth == region), best))
    return regions


@settings(max_examples=200, deadline=None)
@given(label_pairs())
def test_scores_agree_with_independent_computations(pair):
    from skimage.metrics import variation_of_information as peer_information
    from sklearn.metrics import rand_score

    labels, truth = pair
    left = both_labelled(labels, truth)
    counts = Contingency.between(labels, truth)
    assert counts.rand_index() == pytest.approx(rand_score(*left), abs=1e-9)
    over, under = peer_information(left[1], left[0])
    assert counts.variation_of_information() == pytest.approx(under + over, abs=1e-9)
    assert counts.over_segmentation_bits() == pytest.approx(over, abs=1e-9)
    assert counts.under_segmentation_bits() == pytest.approx(under, abs=1e-9)
    regions = direct_overlaps(labels, truth)
    covering = sum(size * best for size, best in regions) / sum(size for size, _ in regions)
    assert counts.region_covering() == pytest.approx(covering, abs=1e-9)
    assert counts.found_regions(0.4) == sum(best > 0.4 for _, best in regions)
    largest = max(range(len(regions)), key=lambda i: regions[i][0])
    others = [best for i, (_, best) in enumerate(regions) if i != largest]
    expected = np.mean(others) if others else np.nan
    assert counts.object_iou() == pytest.approx(expected, abs=1e-9, nan_ok=True)


@settings(max_examples=50, deadline=None)
@given(label_pairs(), st.randoms(use_true_random=False))
def test_scores_do_not_depend_on_what_labels_are_called(pair, random):
    labels, truth = pair
    names = list(range(1, 60_000, 977))
    random.shuffle(names)
    renamed = np.array([0, *names], dtype=np.uint16)[labels]
    for name in ("rand_index", "region_covering", "variation_of_information"):
        score = getattr(Contingency, name)
        expected = score(Contingency.between(labels, truth))
        assert score(Contingency.between(renamed, truth)) == pytest.approx(expected, abs=1e-12)


def test_one_pixel_is_a_perfect_partition():
    assert Contingency.between(np.array([[3]]), np.array([[8]])).rand_index() == 1.0


def test_very_large_labels_take_no_memory_of_their_size():
    labels = np.array([[1, 2**40, 2**40]])
    assert Contingency.between(labels, np.array([[1, 2, 2]])).rand_index() == 1.0


@pytest.mark.parametrize(
    ("labels", "truth", "message"),
    [
        (np.ones((2, 2), np.uint16), np.ones((2, 3), np.uint16), "same shape"),
        (np.ones((2, 2)), np.ones((2, 2), np.uint16), "labels: expected integers"),
        (np.ones((2, 2), np.int32), -np.ones((2, 2), np.int32), "truth: expected labels from 0"),
        (np.array([[1, 0]]), np.array([[0, 1]]), "labeled in both"),
    ],
)
def test_unusable_maps_are_refused(labels, truth, message):
    with pytest.raises(ValueError, match=message):
        Contingency.between(labels, truth).rand_index()


def halves(column):
    image = np.ones((20, 40), dtype=np.uint16)
    image[:, column:] = 2
    return image


@pytest.mark.parametrize(("shift", "expected"), [(0, 1.0), (2, 1.0), (3, 0.0)])
def test_a_boundary_counts_up_to_two_pixels_away(shift, expected):
    scores = boundary_scores(halves(20 + shift), halves(20))
    assert scores == (expected, expected)


def test_a_boundary_too_many_lowers_precision_only():
    labels = halves(20)
    labels[:, 35:] = 3
    assert boundary_scores(labels, halves(20)) == (0.5, 1.0)


def test_without_boundaries_there_is_nothing_to_judge():
    flat = np.ones((20, 40), dtype=np.uint16)
    precision, recall = boundary_scores(flat, halves(20))
    assert np.isnan(precision) and recall == 0.0


def test_boundaries_next_to_unlabelled_pixels_do_not_count():
    truth = halves(20)
    truth[:, 8:12] = 0
    labels = halves(20)
    labels[:, :10] = 3
    assert boundary_scores(labels, truth) == (1.0, 1.0)


def test_boundaries_of_maps_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match="same shape"):
        boundary_scores(halves(3), halves(3)[:, 1:])
