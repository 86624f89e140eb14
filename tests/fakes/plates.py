"""A wall with flat plates on it, nearer to it than a gap: what one surface explains badly and cuts find."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap

SHAPE = (120, 160)
FOCAL = 130.0
#: Inverse depth of the wall and how far a plate stands before it, 1/m: less than the smallest gap, 0.025.
WALL_PER_M, PLATE_PER_M = 0.7, 0.02
#: A segment has at least 25 pixels of the grid of every second pixel. Surfaces are too stiff for a step.
CONFIG = SegmentationConfig(
    decimation=2,
    samples=60,
    extended=ExtendedConfig(
        level="surfaces",
        inverse_depth_noise=5e-4,
        piece_pixels_min=1600,
        knot_spacing_px=50.0,
        smoothness=1.0,
    ),
)
#: Left, top, width and height.
Box = tuple[int, int, int, int]
PLATES: tuple[Box, ...] = ((12, 14, 40, 36), (100, 16, 44, 40), (20, 70, 44, 38), (96, 74, 40, 34))


def plates(
    *shown: Box, frame: int = 0, thing: Box | None = None, nearer_per_m: Sequence[float] = 4 * (PLATE_PER_M,)
) -> PointMap:
    """The wall with some plates in colors of their own, and a thing far before it; noise by the frame."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    inverse_depth = np.full(SHAPE, WALL_PER_M)
    pattern = 110 + 40 * np.sin(columns / 5.0) * np.cos(rows / 4.0)
    color = np.repeat(pattern[..., np.newaxis], 3, axis=2)
    for number, box in enumerate(shown):
        inside = inside_of(box)
        inverse_depth[inside] += nearer_per_m[number]
        color[inside] = (200, 50 + 40 * number, 40)
    if thing is not None:
        inverse_depth[inside_of(thing)] = 1.2
        color[inside_of(thing)] = (30, 60, 220)
    return cloud_of(inverse_depth, color, frame)


def cloud_of(inverse_depth: NDArray[np.float64], color: NDArray[np.float64], frame: int = 0) -> PointMap:
    """A frame of inverse depths, 1/m, with the noise of its number; every pixel has a point."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    depth = 1 / (inverse_depth + 5e-4 * np.random.default_rng(frame).standard_normal(SHAPE))
    points = np.dstack([(columns - 79.5) / FOCAL * depth, (rows - 59.5) / FOCAL * depth, depth])
    return PointMap(
        points.astype(np.float32), color.clip(0, 255).astype(np.uint8), np.ones(SHAPE, dtype=np.bool_)
    )


def inside_of(box: Box) -> tuple[slice, slice]:
    """The pixels of a box."""
    left, top, width, height = box
    return slice(top, top + height), slice(left, left + width)


def rising(frame: int, noise: int | None = None, thing: Box | None = None) -> PointMap:
    """The wall, out of which plates come one after the other, each for five frames, from the first on."""
    nearer = [PLATE_PER_M * min(max(frame - 5 * number, 0) / 5, 1.0) for number in range(4)]
    return plates(*PLATES, frame=frame if noise is None else noise, thing=thing, nearer_per_m=nearer)
