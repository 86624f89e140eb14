"""Borders between planes, whose normals and distances are known, crossing by crossing."""

from itertools import pairwise

import numpy as np
import pytest

from nurbseg.segmentation.objects.border_statistics import (
    APART,
    CONCAVE,
    CONCAVITY,
    CONCAVITY_SQUARE,
    CONVEX,
    FIRST_NEARER,
    FIRST_NORMAL,
    POINT,
    SAMPLES,
    SECOND_NEARER,
    SECOND_NORMAL,
    STEP,
    SUMS,
    TOUCHING,
    add_border,
    border_statistics,
)
from nurbseg.segmentation.points.rays import Rays

FOCAL, CENTER = (300.0, 240.0), (150.0, 10.0)
GAP = 0.05


def pinhole() -> Rays:
    """Rays ((u - cx) / fx, (v - cy) / fy, 1)."""
    coefficients = np.zeros((2, 6, 6))
    coefficients[0, 1, 0], coefficients[1, 0, 1] = 100.0 / FOCAL[0], 100.0 / FOCAL[1]
    return Rays(coefficients, CENTER, 100.0)


def ray(u: float, v: float) -> np.ndarray:
    return np.array([(u - CENTER[0]) / FOCAL[0], (v - CENTER[1]) / FOCAL[1], 1.0])


class Planes:
    """Planes n . p = 1, so that the inverse depth at a pixel is n . ray; the last label has none."""

    def __init__(self, normals: np.ndarray) -> None:
        self.normals = normals

    def __call__(self, label, u, v):
        n = self.normals[label - 1]
        inverse_depth = np.array(
            [each @ ray(*at) for each, at in zip(n, zip(u, v, strict=True), strict=True)]
        )
        return inverse_depth, n[:, 0] / FOCAL[0], n[:, 1] / FOCAL[1]


def crossings(labels: np.ndarray, reach: int):
    """Where a row or column goes from one label to another, over so many pixels of none at most."""
    for turned in (False, True):
        image = labels.T if turned else labels
        for line, row in enumerate(image.tolist()):
            there = [place for place, label in enumerate(row) if label]
            for before, after in pairwise(there):
                if row[before] != row[after] and after - before <= reach:
                    yield turned, line, before, after, row[before], row[after]


def expected_meetings(labels, normals, reach, inset) -> dict[tuple[int, int], np.ndarray]:
    """Sums by pair, in the order of the columns."""
    found: dict[tuple[int, int], np.ndarray] = {}
    for turned, line, *places, one, other in crossings(labels, reach):
        key = min(one, other), max(one, other)
        own = found.setdefault(key, np.zeros(SUMS))
        own[SAMPLES] += 1

        def at(place, turned=turned, line=line):
            return ray(line, place) if turned else ray(place, line)

        inside = [(one, places[0] - inset), (other, places[1] + inset)]
        planes = [normals[label - 1] for label, _ in sorted(inside)]
        gaps = (planes[0] - planes[1]) @ at(sum(places) / 2) / GAP
        own[APART] += min(abs(gaps), 4.0) if np.isfinite(gaps) else 4.0
        if not np.isfinite(gaps):
            continue
        own[STEP] += np.clip(gaps, -4.0, 4.0)
        own[FIRST_NEARER] += gaps > 1
        own[SECOND_NEARER] += gaps < -1
        rays = [at(place) for _, place in sorted(inside)]
        points = [each / (plane @ each) for each, plane in zip(rays, planes, strict=True)]
        towards = [-plane / np.linalg.norm(plane) for plane in planes]
        own[POINT : POINT + 3] += np.mean(points, axis=0)
        own[FIRST_NORMAL : FIRST_NORMAL + 3] += towards[0]
        own[SECOND_NORMAL : SECOND_NORMAL + 3] += towards[1]
        if abs(gaps) < 1:
            chord = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
            turn = -(towards[1] - towards[0]) @ chord
            own[TOUCHING] += 1
            own[CONCAVITY] += turn
            own[CONCAVITY_SQUARE] += turn**2
            own[CONVEX] += turn < -0.15
            own[CONCAVE] += turn > 0.15
    return dict(sorted(found.items()))


@pytest.mark.parametrize(("width", "reach", "inset"), [(320, 3, 2.0), (107, 1, 1.0), (200, 2, 1.25)])
def test_borders_are_measured_crossing_by_crossing(width, reach, inset):
    rng = np.random.default_rng(width)
    blocks = rng.integers(0, 7, (6, 8))
    labels = np.kron(blocks, np.ones((4, 41), dtype=np.int32))[:, :width].astype(np.int32)
    # Gaps of all widths without a point, across and along.
    labels[rng.random(labels.shape) < 0.25] = 0
    normals = rng.normal([0.0, 0.0, 1.0], [0.4, 0.4, 0.02], (7, 3))
    normals[6] = np.nan
    found = border_statistics(labels, Planes(normals), pinhole(), gap_per_m=GAP)
    expected = expected_meetings(labels, normals, reach, inset)
    assert len(expected) > 10
    assert found.labels.tolist() == [list(pair) for pair in expected]
    np.testing.assert_allclose(found.sums, list(expected.values()), atol=1e-9)
    assert (found.sums[:, TOUCHING] > 0).any()
    assert (found.sums[:, TOUCHING] < found.sums[:, SAMPLES]).any()


def test_a_single_label_has_no_borders():
    labels = np.ones((5, 9), dtype=np.int32)
    labels[2, 3:6] = 0
    for image in (labels, 0 * labels):
        found = border_statistics(image, Planes(np.ones((1, 3))), pinhole(), gap_per_m=GAP)
        assert found.labels.shape == (0, 2)
        assert found.sums.shape == (0, SUMS)


def test_borders_of_merged_surfaces_add_up_whichever_is_first():
    rng = np.random.default_rng(3)
    labels = np.kron(rng.integers(0, 7, (6, 8)), np.ones((4, 40), dtype=np.int32)).astype(np.int32)
    normals = rng.normal([0.0, 0.0, 1.0], [0.4, 0.4, 0.02], (7, 3))
    found = border_statistics(labels, Planes(normals), pinhole(), gap_per_m=GAP)
    sums = dict(zip(map(tuple, found.labels.tolist()), found.sums, strict=True))
    # The same image with labels in reverse: first and second change places in every pair.
    turned = np.where(labels > 0, 8 - labels, 0).astype(np.int32)
    other = border_statistics(turned, Planes(normals[::-1]), pinhole(), gap_per_m=GAP)
    reverse = dict(zip(map(tuple, other.labels.tolist()), other.sums, strict=True))
    assert len(sums) > 10
    for (first, second), own in sums.items():
        total = own.copy()
        add_border(total, reverse[8 - second, 8 - first], True)
        np.testing.assert_allclose(total, 2 * own, atol=1e-9)
        add_border(total, own, False)
        np.testing.assert_allclose(total, 3 * own, atol=1e-9)


def test_what_is_at_infinity_has_no_crease():
    def evaluate(label, u, v):
        return np.where(label == 1, 0.0, 0.2 * GAP), np.zeros(label.size), np.zeros(label.size)

    labels = np.repeat([[1, 2]], 3, axis=0).repeat(20, axis=1).astype(np.int32)
    found = border_statistics(labels, evaluate, pinhole(), gap_per_m=GAP)
    assert found.sums[0, [SAMPLES, TOUCHING]].tolist() == [3, 0]
    assert found.sums[0, APART] == pytest.approx(0.6)
