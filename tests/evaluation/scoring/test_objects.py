"""Scores of objects, against all assignments tried one by one and sets of pixels counted by hand."""

from __future__ import annotations

import tracemalloc
from itertools import permutations

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.evaluation.scoring.objects import object_scores, without_background

Pixels = set[tuple[int, int]]


def pixels_of(image: NDArray[np.integer], label: int) -> Pixels:
    return set(zip(*(each.tolist() for each in np.nonzero(image == label)), strict=True))


def boundary_of(image: NDArray[np.integer], label: int) -> Pixels:
    """Pixels of the image with a neighbor to the right, below or both on the other side."""
    own, (height, width) = pixels_of(image, label), image.shape
    edges = set()
    for row in range(height):
        for column in range(width):
            others = [(row, column + 1), (row + 1, column), (row + 1, column + 1)]
            inside = [other for other in others if other[0] < height and other[1] < width]
            if any((each in own) != ((row, column) in own) for each in inside):
                edges.add((row, column))
    return edges


def near(edges: Pixels, others: Pixels, radius: int) -> int:
    return sum(any((a - c) ** 2 + (b - d) ** 2 <= radius**2 for c, d in others) for a, b in edges)


def by_hand(objects: NDArray[np.integer], truth: NDArray[np.integer]) -> list[float]:
    found, true = (sorted(set(image.ravel().tolist()) - {0}) for image in (objects, truth))

    def f(label: int, of_truth: int) -> float:
        a, b = pixels_of(objects, label), pixels_of(truth, of_truth)
        precision, recall = len(a & b) / len(a), len(a & b) / len(b)
        return 2 * precision * recall / (precision + recall) if precision + recall else 0.0

    few, many, turned = (found, true, False) if len(found) <= len(true) else (true, found, True)
    tried = []
    for chosen in permutations(many, len(few)):
        pairs = [(b, a) if turned else (a, b) for a, b in zip(few, chosen, strict=True)]
        tried.append((sum(f(*pair) for pair in pairs), pairs))
    _, pairs = max(tried)
    common = sum(len(pixels_of(objects, a) & pixels_of(truth, b)) for a, b in pairs)
    scores = [common / np.count_nonzero(objects), common / np.count_nonzero(truth)]
    scores.append(2 * scores[0] * scores[1] / (scores[0] + scores[1]))
    radius = int(np.ceil(0.003 * np.sqrt(objects.shape[0] ** 2 + objects.shape[1] ** 2)))
    precision = sum(near(boundary_of(objects, a), boundary_of(truth, b), radius) for a, b in pairs)
    recall = sum(near(boundary_of(truth, b), boundary_of(objects, a), radius) for a, b in pairs)
    precision /= sum(len(boundary_of(objects, a)) for a in found)
    recall /= sum(len(boundary_of(truth, b)) for b in true)
    scores += [precision, recall, 2 * precision * recall / (precision + recall)]
    return [*scores, sum(f(*pair) >= 0.75 for pair in pairs) / len(true)]


@pytest.mark.parametrize("seed", range(6))
def test_scores_are_those_of_the_best_of_all_assignments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = np.zeros((24, 32), dtype=np.uint16)
    for label in (3, 7, 8, 20):
        row, column = rng.integers(0, (16, 22))
        truth[row : row + rng.integers(4, 9), column : column + rng.integers(4, 11)] = label
    objects = np.roll(truth, rng.integers(-1, 2, 2), axis=(0, 1)) * 2
    objects[objects == 14] = rng.choice([14, 0])
    row, column = rng.integers(0, (16, 22))
    objects[row : row + 5, column : column + 9] = 5
    objects[:2, :3] = 9
    assert np.allclose(object_scores(objects, truth), by_hand(objects, truth), atol=1e-12)


def test_the_ground_truth_itself_is_perfect_and_nothing_is_nothing() -> None:
    truth = np.zeros((20, 20), dtype=np.uint16)
    none = np.zeros_like(truth)
    truth[3:9, 4:9] = 4
    assert tuple(object_scores(truth, truth)) == (1.0,) * 7
    assert object_scores(none, truth) == (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    assert object_scores(truth, none)[:6] == (0.0, 1.0, 0.0, 0.0, 1.0, 0.0)
    assert np.isnan(object_scores(truth, none).found)
    with pytest.raises(ValueError, match="of the same shape"):
        object_scores(truth, none[:5])


def test_the_background_is_the_largest_segment_and_what_is_in_its_plane() -> None:
    v, u = np.mgrid[:60, :80]
    x, y = (u - 39.5) / 70.0, (v - 29.5) / 70.0
    # A table seen from above, which rises to the left, and things 8 cm over it.
    inverse_depth = 0.9 + 0.2 * y + 0.1 * x
    labels = np.full((60, 80), 3, dtype=np.uint16)
    labels[5:20, 50:75] = 4  # another part of the table
    labels[30:50, 10:30] = 6
    z = 1.0 / inverse_depth
    z[labels == 6] -= 0.08
    points = np.stack([x * z, y * z, z], axis=-1).astype(np.float32)
    points[:3] = np.nan
    labels[:3] = 0
    left = without_background(labels, points)
    assert np.unique(left).tolist() == [0, 6]
    assert np.array_equal(left == 6, labels == 6)
    assert not without_background(np.zeros_like(labels), points).any()


def test_the_largest_segment_is_background_though_it_is_no_plane() -> None:
    rows, columns = np.mgrid[:60, :80]
    z = 1.0 + 0.3 * np.sin(columns / 6.0)
    labels = np.full(z.shape, 2)
    labels[10:20, 10:20], z[10:20, 10:20] = 5, 0.4
    points = np.stack([(columns - 40) / 70 * z, (rows - 30) / 70 * z, z], axis=-1).astype(np.float32)
    assert np.array_equal(without_background(labels, points), np.where(labels == 5, 5, 0))


def test_thousands_of_objects_take_no_mask_of_the_image_each() -> None:
    truth = 1 + np.arange(120 * 160).reshape(120, 160) % 3000
    tracemalloc.start()
    try:
        object_scores(np.ones_like(truth), truth)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 0.5 * truth.size * 3000
