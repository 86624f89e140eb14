"""Clouds with a known shape, seen by a plain camera."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.segmentation.points.registration import PointMap

CloudOf = Callable[..., PointMap]


@pytest.fixture
def cloud_of() -> CloudOf:
    """A function that back-projects a depth image (meters, NaN for none) with one color or an image."""

    def build(depth_m: NDArray[np.float64], color: object = (120, 120, 120)) -> PointMap:
        height, width = depth_m.shape
        focal = 0.8 * width
        rows, columns = np.mgrid[:height, :width]
        points = np.empty((height, width, 3), dtype=np.float32)
        points[..., 0] = (columns - 0.5 * (width - 1)) * depth_m / focal
        points[..., 1] = (rows - 0.5 * (height - 1)) * depth_m / focal
        points[..., 2] = depth_m
        image = np.empty((height, width, 3), dtype=np.uint8)
        image[:] = np.asarray(color, dtype=np.uint8)
        return PointMap(points, image, np.isfinite(depth_m))

    return build


def _rays(size: tuple[int, int]) -> NDArray[np.float64]:
    rows, columns = np.mgrid[: size[0], : size[1]]
    focal = 0.8 * size[1]
    x, y = (columns - 0.5 * (size[1] - 1)) / focal, (rows - 0.5 * (size[0] - 1)) / focal
    return np.stack([x, y, np.ones(size)], axis=-1)


def _box_on_table(
    size: tuple[int, int] = (240, 320), noise_per_m: float = 0.0, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Depth in meters and truth: 1 the table, 2 the top, 3 the front and 4 the side of a box on it."""
    directions = _rays(size)
    # The world: z up from the table. The camera looks down at it from in front.
    tilt = np.radians(40)
    rotation = np.array([[1, 0, 0], [0, -np.sin(tilt), np.cos(tilt)], [0, -np.cos(tilt), -np.sin(tilt)]])
    turn = np.radians(25)
    spin = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    world = directions @ rotation.T @ spin.T
    origin = spin @ np.array([0.0, -0.8, 0.75])
    half = np.array([0.16, 0.12, 0.2])
    depth = np.full(size, np.inf)
    truth = np.zeros(size, dtype=np.int32)

    def hit(distance, inside, label):
        nearer = inside & (distance > 0) & (distance < depth)
        depth[nearer], truth[nearer] = distance[nearer], label

    with np.errstate(divide="ignore", invalid="ignore"):
        hit(-origin[2] / world[..., 2], world[..., 2] < 0, 1)
        for axis, sign, label in ((2, 1, 2), (1, -1, 3), (0, -1, 4), (0, 1, 4)):
            face = half[axis] * sign
            distance = (face - origin[axis]) / world[..., axis]
            point = origin + world * distance[..., np.newaxis]
            others = [each for each in range(3) if each != axis]
            inside = np.all([np.abs(point[..., o]) <= half[o] for o in others], axis=0)
            inside &= (point[..., 2] >= 0) & (sign * world[..., axis] < 0)
            hit(distance, inside, label)
    rng = np.random.default_rng(seed)
    inverse_depth = 1 / depth + noise_per_m * rng.normal(size=size)
    return 1 / inverse_depth, truth


@pytest.fixture
def box_on_table() -> Callable[..., tuple[NDArray[np.float64], NDArray[np.int32]]]:
    """A function that renders a box on a table, of a size and with some noise of inverse depth."""
    return _box_on_table


@pytest.fixture
def rays_of_size() -> Callable[[tuple[int, int]], NDArray[np.float64]]:
    """A function that returns the rays (x / z, y / z, 1) of the camera that `cloud_of` sees with."""
    return _rays
