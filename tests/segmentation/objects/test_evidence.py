"""Features of pairs of surfaces by their definitions, pair by pair, and what they weigh."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from nurbseg.segmentation.objects.border_statistics import BorderStatistics
from nurbseg.segmentation.objects.evidence import BASE, GAP, ITEMS, TERMS, evidence, pair_features
from nurbseg.segmentation.objects.surface_statistics import SurfaceStatistics

NOISE = 2.5e-3


def frame(seed, count=8):
    """Borders and surfaces of a made-up frame; the last surface has no place."""
    rng = np.random.default_rng(seed)
    pairs = np.array([pair for pair in combinations(range(1, count + 1), 2) if rng.random() < 0.7])
    samples = rng.integers(1, 60, len(pairs)).astype(float)
    samples[0] = 1.0
    touching = np.floor(samples * rng.choice([0.0, 0.1, 0.5, 1.0], len(pairs)))
    turns = rng.normal(0.1, 0.5, (len(pairs), 60)) * (np.arange(60) < touching[:, np.newaxis])
    borders = BorderStatistics(
        pairs, samples, touching, turns.sum(axis=1), np.square(turns).sum(axis=1), samples * rng.uniform(0, 4)
    )
    normals = rng.normal([0, 0, -1], 0.5, (count + 1, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centers = rng.normal([0, 0, 1.5], 0.2, (count + 1, 3))
    pixels = rng.permutation(np.geomspace(60, 90_000, count + 1))
    for values in (normals, centers, pixels):
        values[0] = values[count] = 0
    return borders, SurfaceStatistics(pixels, centers, normals)


def renumbered(borders, surfaces, order):
    """The same frame with label k called order[k]."""
    labels = np.sort(order[borders.labels], axis=1)
    back = np.argsort(order)
    others = (getattr(borders, name) for name in ("samples", "touching", "concavity"))
    return (
        BorderStatistics(labels, *others, borders.concavity_square, borders.apart),
        SurfaceStatistics(surfaces.pixels[back], surfaces.center_m[back], surfaces.normal[back]),
    )


def defined(borders, surfaces, n):
    """Features of the n-th pair, one by one."""
    first, second = borders.labels[n]
    small, large = sorted((first, second), key=lambda label: surfaces.pixels[label])
    count = max(borders.touching[n], 1)
    mean = borders.concavity[n] / count
    variance = borders.concavity_square[n] / count - mean**2
    around = sum(
        length for pair, length in zip(borders.labels, borders.samples, strict=True) if small in pair
    )
    apart_m = surfaces.center_m[small] - surfaces.center_m[large]
    deviation_m = NOISE * max(surfaces.center_m[small][2], 1e-3) ** 2
    return {
        "concave": min(max(mean, 0), 1.0),
        "uneven": min(np.sqrt(max(variance, 0)), 0.6),
        "apart": borders.apart[n] / borders.samples[n],
        "enclosed": borders.samples[n] / around,
        "larger": np.log(max(surfaces.pixels[large], 1)),
        "front": np.arcsinh(apart_m @ surfaces.normal[large] / deviation_m),
    }


@pytest.mark.parametrize("seed", range(4))
def test_features_are_what_they_are_defined_to_be(seed):
    borders, surfaces = frame(seed)
    found = pair_features(borders, surfaces, NOISE)
    for n in range(len(found)):
        expected = defined(borders, surfaces, n)
        assert list(expected) == [term.name for term in TERMS]
        np.testing.assert_allclose(found[n], list(expected.values()), atol=1e-12)


def test_evidence_does_not_depend_on_the_order_of_labels():
    borders, surfaces = frame(0)
    order = np.array([0, 5, 2, 8, 1, 7, 3, 6, 4])
    np.testing.assert_array_equal(
        evidence(borders, surfaces, NOISE), evidence(*renumbered(borders, surfaces, order), NOISE)
    )


def test_evidence_does_not_depend_on_the_size_of_the_image_or_the_unit_of_borders():
    borders, surfaces = frame(1)
    sums = (borders.samples, borders.touching, borders.concavity, borders.concavity_square, borders.apart)
    twice = BorderStatistics(borders.labels, *(2.0 * each for each in sums))
    touch = borders.in_contact
    assert touch.any()
    np.testing.assert_allclose(
        evidence(borders, surfaces, NOISE)[touch], evidence(twice, surfaces, NOISE)[touch], atol=1e-12
    )


def test_terms_are_weights_times_features_and_a_gap_is_the_only_term():
    borders, surfaces = frame(2)
    items, features = evidence(borders, surfaces, NOISE), pair_features(borders, surfaces, NOISE)
    assert items.shape[1] == len(ITEMS)
    assert 0 < np.count_nonzero(borders.in_contact) < len(items)
    for found, of_pair, touch in zip(items, features, borders.in_contact, strict=True):
        if touch:
            weighed = [
                term.weight * (value - term.neutral) for term, value in zip(TERMS, of_pair, strict=True)
            ]
            expected = [BASE, *weighed, 0.0, 0.0]
        else:
            expected = [0.0] * (len(ITEMS) - 2) + [GAP, 0.0]
        np.testing.assert_allclose(found, expected, atol=5.1e-4)
        # Three digits, those that are exported.
        assert found.tolist() == [round(item, 3) for item in found.tolist()]


def test_weights_are_those_that_are_published():
    page = (Path(__file__).parents[3] / "docs/default-method.md").read_text()
    rows = (line.split("|") for line in page.splitlines())
    table = {row[1].strip(" `"): row[3:5] for row in rows if len(row) == 6}
    assert float(table["base"][0]) == BASE
    for term in TERMS:
        assert [float(each) for each in table[term.name]] == [term.weight, term.neutral]
    assert f"log odds are {GAP} regardless" in page


def test_concavity_gaps_and_size_have_the_right_sign():
    weights = {term.name: term.weight for term in TERMS}
    assert all(weights[name] < 0 for name in ("concave", "apart", "larger", "front"))
    assert weights["enclosed"] > 0
