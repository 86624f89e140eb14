"""Depth images of boxes on a table, by the intersection of rays with slabs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import RGBDFrame

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0


@dataclass(frozen=True)
class StandingBox:
    """A box on the table: where its middle stands, its sizes and its turn about the vertical, radians."""

    x: float
    y: float
    size: tuple[float, float, float]
    yaw: float
    color: tuple[int, int, int]

    def world_from_box(self) -> NDArray[np.float64]:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        pose = np.eye(4)
        pose[:3] = [[c, -s, 0, self.x], [s, c, 0, self.y], [0, 0, 1, self.size[2] / 2]]
        return pose


BOXES = (
    StandingBox(-0.2, 0.05, (0.2, 0.1, 0.16), 0.4, (200, 40, 40)),
    StandingBox(0.2, 0.0, (0.24, 0.12, 0.1), -0.5, (40, 170, 60)),
    StandingBox(0.0, 0.35, (0.14, 0.1, 0.24), 0.2, (50, 70, 200)),
)


def looking(eye: tuple[float, float, float], target: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return world_from_camera of a level camera at `eye`; the world's z is up."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(forward, right), forward, eye])
    return pose


def seen(
    world_from_camera: NDArray[np.float64],
    boxes: tuple[StandingBox, ...] = BOXES,
    index: int = 0,
    noise: float = 0.001,
) -> RGBDFrame:
    """Return what the camera sees: the table z = 0 with boxes; noise is that of inverse depth, 1/m."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - WIDTH / 2 + 0.5) / FOCAL, (v - HEIGHT / 2 + 0.5) / FOCAL, np.ones(u.shape)], -1)
    turn, eye = world_from_camera[:3, :3], world_from_camera[:3, 3]
    toward = rays @ turn.T
    depth = -eye[2] / np.where(toward[..., 2] < 0, toward[..., 2], np.nan)
    color = np.full((HEIGHT, WIDTH, 3), 150, np.uint8)
    for box in boxes:
        box_from_world = np.linalg.inv(box.world_from_box())
        start, along = box_from_world[:3, :3] @ eye + box_from_world[:3, 3], toward @ box_from_world[:3, :3].T
        half = np.array(box.size) / 2
        first, second = (-half - start) / along, (half - start) / along
        near, far = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
        hit = (near <= far) & (near > 0) & ~(near >= depth)
        depth[hit] = near[hit]
        color[hit] = box.color
    rng = np.random.default_rng(index)
    noisy = 1.0 / (1.0 / depth + rng.normal(0, noise, depth.shape))
    depth_mm = np.nan_to_num(1000 * noisy, nan=0).clip(0, 4000).round().astype(np.uint16)
    frame = RGBDFrame.from_arrays(depth_mm, color, FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
    object.__setattr__(frame, "index", index)
    object.__setattr__(frame, "timestamp_ns", index * 33_333_333)
    return frame
