"""Borders between planes, whose normals and distances are known, crossing by crossing."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from nurbseg.segmentation.objects.border_statistics import BorderStatistics, border_statistics
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


def expected_meetings(labels, normals, reach, inset) -> dict[tuple[int, int], list[float]]:
    """By pair: samples, touching ones, their concavities' sum and sum of squares, and distances in gaps."""
    found: dict[tuple[int, int], list[float]] = {}
    for turned, line, before, after, one, other in crossings(labels, reach):
        key = min(one, other), max(one, other)
        counts = found.setdefault(key, [0, 0, 0.0, 0.0, 0.0])
        counts[0] += 1

        def at(place, turned=turned, line=line):
            return ray(line, place) if turned else ray(place, line)

        planes = [normals[one - 1], normals[other - 1]]
        middle = at((before + after) / 2)
        apart = abs(planes[0] @ middle - planes[1] @ middle)
        counts[4] += min(apart / GAP, 4.0) if np.isfinite(apart) else 4.0
        if not apart < GAP:
            continue
        counts[1] += 1
        rays = [at(before - inset), at(after + inset)]
        points = [each / (plane @ each) for each, plane in zip(rays, planes, strict=True)]
        towards = [-plane / np.linalg.norm(plane) for plane in planes]
        chord = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
        turn = -(towards[1] - towards[0]) @ chord
        counts[2] += turn
        counts[3] += turn**2
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
    sums = (found.samples, found.touching, found.concavity, found.concavity_square, found.apart)
    np.testing.assert_allclose(np.stack(sums, axis=1), list(expected.values()), atol=1e-9)
    assert (found.touching > 0).any()
    assert (found.touching < found.samples).any()


def test_every_few_rows_and_columns_are_measured_like_an_image_of_their_own():
    rng = np.random.default_rng(0)
    labels = np.kron(rng.integers(0, 7, (6, 8)), np.ones((4, 27), dtype=np.int32)).astype(np.int32)
    planes = Planes(rng.normal([0.0, 0.0, 1.0], [0.4, 0.4, 0.02], (7, 3)))

    def on_grid(label, u, v):
        inverse_depth, along_u, along_v = planes(label, 3 * u, 3 * v)
        return inverse_depth, 3 * along_u, 3 * along_v

    found = border_statistics(labels, planes, pinhole(), gap_per_m=GAP, step=3)
    rays = replace(pinhole(), center=(CENTER[0] / 3, CENTER[1] / 3), scale=100.0 / 3)
    expected = border_statistics(labels, on_grid, rays, gap_per_m=GAP)
    assert np.array_equal(found.labels, expected.labels)
    assert (found.touching > 0).any()
    for name in ("samples", "touching", "concavity", "concavity_square", "apart"):
        np.testing.assert_allclose(getattr(found, name), 3 * getattr(expected, name), atol=1e-9)


def test_a_single_label_has_no_borders():
    labels = np.ones((5, 9), dtype=np.int32)
    labels[2, 3:6] = 0
    for image in (labels, 0 * labels):
        found = border_statistics(image, Planes(np.ones((1, 3))), pinhole(), gap_per_m=GAP)
        assert found.labels.shape == (0, 2)
        assert found.in_contact.shape == (0,)


def test_contact_takes_four_places_and_a_share_of_all():
    samples, touching = np.array([[3, 3], [4, 4], [40, 4], [41, 4], [60, 6], [61, 6]], dtype=float).T
    borders = BorderStatistics(np.zeros((6, 2), dtype=np.int64), samples, touching, *np.zeros((3, 6)))
    assert borders.in_contact.tolist() == [False, True, True, False, True, False]


def test_what_is_at_infinity_touches_without_a_crease():
    def evaluate(label, u, v):
        return np.where(label == 1, 0.0, 0.2 * GAP), np.zeros(label.size), np.zeros(label.size)

    labels = np.repeat([[1, 2]], 3, axis=0).repeat(20, axis=1).astype(np.int32)
    found = border_statistics(labels, evaluate, pinhole(), gap_per_m=GAP)
    assert (found.samples, found.touching) == (3, 3)
    assert (found.concavity, found.concavity_square) == (0, 0)
    assert found.apart == pytest.approx(0.6)
