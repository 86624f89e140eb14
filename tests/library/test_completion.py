"""The far half of what is rounded, and the ends of boxes, against shapes of which both are known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.library.boxes.boxes import BoxEnds, box_ends
from nurbseg.library.boxes.completion import completed
from nurbseg.library.boxes.support import Support

UP = np.array([0.0, 1.0, 0.0])
#: 1 m below the camera.
SUPPORT = Support(UP, 1.0, "largest", np.array([0.0]))
NOISE = 5e-4


def seen_points(
    shape: str, half: tuple[float, float, float], yaw: float, place: tuple[float, float]
) -> NDArray[np.float64]:
    """Return what is seen of a thing on the support, evenly in the image: x right, y up, z away."""
    rng = np.random.default_rng(2)
    count, radii = 400_000, np.array(half)
    if shape == "box":
        normals = np.zeros((count, 3))
        side = rng.integers(0, 3, count)
        points = rng.uniform(-1, 1, (count, 3))
        normals[np.arange(count), side] = np.sign(points[np.arange(count), side])
        points[np.arange(count), side] = normals[np.arange(count), side]
        points *= radii
    else:
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points, normals = directions * radii, directions / radii
    if shape == "bowl":
        # Its lower half from within, moved up.
        inside = points[:, 1] < 0
        points, normals = points[inside] + [0, radii[1] / 2, 0], -normals[inside]
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    points, normals = points @ turn.T, normals @ turn.T
    points += [place[0], half[1] - 1.0, place[1]]
    toward = -(points * normals).sum(axis=1) / np.linalg.norm(normals, axis=1)
    # A pixel sees more of what is slanted.
    squared = (points**2).sum(axis=1)
    chosen = toward / squared**1.5 > rng.uniform(0, 2, len(points)) * np.percentile(toward / squared**1.5, 99)
    return points[chosen & (toward > 0)][:3000]


def whole(points: NDArray[np.float64]) -> BoxEnds:
    bounds = np.array([0, len(points)])
    return completed(box_ends(points, bounds, UP[np.newaxis]), points, bounds, SUPPORT, NOISE)


@pytest.mark.parametrize("yaw", [0.0, 0.5, 1.2])
@pytest.mark.parametrize("place", [(0.1, 1.2), (-0.4, 1.6)])
@pytest.mark.parametrize("half", [(0.045, 0.045, 0.045), (0.06, 0.05, 0.05), (0.09, 0.06, 0.07)])
def test_the_far_half_of_what_is_rounded_is_taken_to_be_like_the_near_one(
    half: tuple[float, float, float], place: tuple[float, float], yaw: float
) -> None:
    points = seen_points("ellipsoid", half, yaw, place)
    box = whole(points)
    center = ((box.low[0] + box.high[0]) / 2) @ box.axes[0]
    np.testing.assert_allclose(center, [place[0], half[1] - 1.0, place[1]], atol=0.12 * max(half))
    sides = 2 * np.array([half[0], half[2], half[1]])
    np.testing.assert_allclose(box.high[0] - box.low[0], sides, rtol=0.14)
    # Strays are left out at curved ends, so no side is longer.
    assert (box.high[0] - box.low[0] < 1.01 * sides).all()
    # What is seen of it ends before its middle plus half of it.
    assert points[:, 2].max() < place[1] + 0.9 * min(half[0], half[2])


@pytest.mark.parametrize("shape", ["box", "bowl"])
def test_what_is_not_rounded_is_as_long_as_it_is_seen(shape: str) -> None:
    points = seen_points(shape, (0.12, 0.06, 0.08), 0.3, (0.1, 1.2))
    bounds = np.array([0, len(points)])
    visible, box = box_ends(points, bounds, UP[np.newaxis]), whole(points)
    for name in ("axes", "high", "roundness"):
        np.testing.assert_array_equal(getattr(box, name), getattr(visible, name))
    np.testing.assert_array_equal(box.low[0, :2], visible.low[0, :2])
    if shape == "box":
        np.testing.assert_allclose((box.high - box.low)[0], [0.24, 0.16, 0.12], atol=0.012)
        center = ((box.low[0] + box.high[0]) / 2) @ box.axes[0]
        np.testing.assert_allclose(center, [0.1, -0.94, 1.2], atol=0.01)


def test_what_is_uneven_is_not_completed_though_it_is_round() -> None:
    points = seen_points("ellipsoid", (0.06, 0.06, 0.06), 0.0, (0.1, 1.2))
    middle = np.array([0.1, -0.94, 1.2])
    uneven = middle + (points - middle) * np.random.default_rng(4).uniform(0.85, 1.0, (len(points), 1))
    for shape, is_completed in ((points, True), (uneven, False)):
        bounds = np.array([0, len(shape)])
        visible, box = box_ends(shape, bounds, UP[np.newaxis]), whole(shape)
        longer = np.prod((box.high - box.low)[0, :2]) / np.prod((visible.high - visible.low)[0, :2])
        assert (longer > 1.1) == is_completed


def test_noise_does_not_make_boxes_larger() -> None:
    rng = np.random.default_rng(5)
    points = seen_points("box", (0.12, 0.06, 0.08), 0.3, (0.1, 1.2))
    noise = 3e-3
    noisy = points * (1.0 + noise * points[:, 2:] * rng.normal(size=(len(points), 1)))
    bounds = np.array([0, len(points)])
    plain, without, corrected = (
        ends.high - ends.low
        for ends in (
            box_ends(points, bounds, UP[np.newaxis]),
            box_ends(noisy, bounds, UP[np.newaxis]),
            box_ends(noisy, bounds, UP[np.newaxis], noise),
        )
    )
    # Along the view the noise is 4 mm.
    assert (without - plain)[0, 1] > 0.008
    assert (np.abs(corrected - plain) < 0.01).all()
    assert (np.abs(corrected - plain)[0, 1:] < 0.6 * np.abs(without - plain)[0, 1:]).all()
