"""The synthetic scene: the objects on the table, their motion and the camera's path.

World frame: x to the right, y away from the viewer, z up, meters; the table top is z = 0.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scene import textures
from scene.shapes import Shape, bowl, box, cushion, cylinder, ellipsoid, rectangle

#: Ticks of the scene's clock per second, and those in which camera and ball return to where they were.
TICKS_PER_S = 30.0
PERIOD = 120
_BALL_RADIUS_M = 0.045
_BALL_NAME = "ball"
#: How far the ball rolls to either side, and behind the screen's middle, meters.
_REACH_M = 0.6
_BEHIND_M = 0.19
#: The box that the ball rolls behind where the scene is to hide it.
_SCREEN_NAME = "carton"


@dataclass(frozen=True, slots=True, eq=False)
class RenderedObject:
    """One thing of the scene: its form in its own frame, and where it stands at the start.

    The texture (H, W, 3) is RGB, the pose (4, 4), and shininess the strength of the highlight, 0 to 1.
    """

    name: str
    shape: Shape
    texture: NDArray[np.uint8]
    world_from_object: NDArray[np.float64]
    shininess: float = 0.0


class RenderedScene:
    """A table before a wall, with boxes, tins, a bowl, fruit, a cushion and a ball that rolls.

    The seed determines textures and positions; the objects stay the same. `hidden_ticks` is 0 to let the ball
    roll in front, else for how many ticks it shall be wholly behind the carton, at most, halfway through the
    period.
    """

    def __init__(self, seed: int, hidden_ticks: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.seed = seed
        self._hidden_ticks = hidden_ticks
        self._phase = float(rng.uniform(-0.4, 0.4)) if seed else 0.0
        self.objects = tuple(_objects(rng, 0.0 if seed == 0 else 1.0))
        self.names = tuple(each.name for each in self.objects)
        self.ball = self.names.index(_BALL_NAME)
        self.ball_radius_m = _BALL_RADIUS_M
        self._screen = self.objects[self.names.index(_SCREEN_NAME)]
        self._hidden_step_m = self._step_that_hides(hidden_ticks) if hidden_ticks else 0.0

    def world_from_depth(self, tick: float) -> NDArray[np.float64]:
        """Return the depth camera's pose: on an arc about the table, with a hand's tremor."""
        turn = 2 * np.pi * tick / PERIOD + self._phase
        azimuth = 0.20 * np.sin(turn)
        distance, height = 0.90 + 0.03 * np.cos(2 * turn), 0.58 + 0.03 * np.sin(turn + 1)
        tremor = 0.0015 * np.array([np.sin(9 * turn), np.sin(11 * turn + 2), np.sin(13 * turn + 4)])
        eye = np.array([distance * np.sin(azimuth), -distance * np.cos(azimuth), height]) + tremor
        target = np.array([0.03, 0.03, 0.055]) + 1.5 * tremor[::-1]
        return look_at(eye, target)

    def world_from_object(self, number: int, tick: float) -> NDArray[np.float64]:
        """Return an object's pose at a moment."""
        pose = self.objects[number].world_from_object
        if number != self.ball:
            return pose
        x, y = self._ball_place(tick)
        moved = pose.copy()
        # It rolls without slipping, from where x is 0.
        moved[:3, :3] = cv2.Rodrigues(np.array([0.0, x / _BALL_RADIUS_M, 0.0]))[0] @ pose[:3, :3]
        moved[:3, 3] = x, y, _BALL_RADIUS_M
        return moved

    def _ball_place(self, tick: float) -> tuple[float, float]:
        if not self._hidden_ticks:
            return -0.36 * float(np.cos(2 * np.pi * tick / PERIOD)), -0.34
        x, y = self._behind_screen()
        return float(_triangle_wave(x + self._hidden_step_m * (tick - PERIOD // 2))), y

    def _behind_screen(self) -> tuple[float, float]:
        """Return the position behind the screen's middle, as seen halfway through the period."""
        eye = self.world_from_depth(PERIOD // 2)[:3, 3]
        center = self._screen.world_from_object[:3, 3]
        y = center[1] + _BEHIND_M
        return float(eye[0] + (y - eye[1]) / (center[1] - eye[1]) * (center[0] - eye[0])), float(y)

    def _step_that_hides(self, ticks: int) -> float:
        """Return how far the ball moves per tick, meters, so that the screen never hides it for longer.

        Seen from above, the screen covers a sector; the ball is hidden while its own sector lies within.
        """
        eyes = np.array([self.world_from_depth(tick)[:2, 3] for tick in range(PERIOD)])
        corners = self._screen.world_from_object[:3, :3] @ self._screen.shape.corners_m.T
        edges = corners[:2].T + self._screen.world_from_object[:2, 3] - eyes[:, None]
        bearings = np.arctan2(edges[..., 0], edges[..., 1])
        x, y = self._behind_screen()
        for step in np.geomspace(0.002, 0.3, 400):
            xs = _triangle_wave(x + step * (np.arange(PERIOD) - PERIOD // 2))
            rays = np.stack([xs, np.full(PERIOD, y)], axis=1) - eyes
            bearing = np.arctan2(rays[:, 0], rays[:, 1])
            # A sliver of the ball can slip between pixels: what counts is a little less than all of it.
            half = np.arcsin((_BALL_RADIUS_M - 0.003) / np.hypot(*rays.T))
            hidden = (bearing - half > bearings.min(axis=1)) & (bearing + half < bearings.max(axis=1))
            changes = np.flatnonzero(np.diff(np.concatenate([[False], hidden, [False]])))
            if (changes[1::2] - changes[::2]).max(initial=0) <= ticks:
                return float(step)
        return 0.3


def _triangle_wave(distance: Any) -> Any:
    """Return the position on a line after moving back and forth between its ends by this distance."""
    phase = (distance + _REACH_M) % (4 * _REACH_M)
    return np.minimum(phase, 4 * _REACH_M - phase) - _REACH_M


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) pose of a camera at `eye` whose axis meets `target`, its x level."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def _objects(rng: np.random.Generator, spread: float) -> Iterator[RenderedObject]:
    """Yield the objects; the order in which they draw random numbers is part of what a seed means."""

    def placed(x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> NDArray[np.float64]:
        pose = np.eye(4)
        turn = np.deg2rad(yaw + spread * rng.uniform(-15, 15))
        pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        pose[:3, 3] = x + spread * rng.uniform(-0.02, 0.02), y + spread * rng.uniform(-0.02, 0.02), z
        return pose

    table, wall = np.eye(4), np.eye(4)
    table[:3, 3] = 0.0, -0.08, 0.0
    # The wall's own z axis points at the viewer.
    wall[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    wall[:3, 3] = 0.0, 0.62, 0.9
    book = placed(0.09, 0.2, 0.02, 12)
    on_book = book.copy()
    on_book[:3, 3] += [0.01, 0.0, 0.06]

    yield RenderedObject("table", rectangle(1.4, 0.7), textures.wood(rng, 700, 1400), table)
    yield RenderedObject("wall", rectangle(3.0, 1.2), textures.plaster(rng, 480, 1200), wall)
    texture = textures.printed(rng, (196, 62, 44), (246, 190, 60))
    yield RenderedObject(_SCREEN_NAME, box(0.095, 0.035, 0.14), texture, placed(-0.34, 0.2, 0.14, 18), 0.12)
    texture = textures.printed(rng, (58, 110, 92), (226, 214, 170))
    yield RenderedObject("packet", box(0.07, 0.045, 0.032), texture, placed(0.05, -0.14, 0.032, -28), 0.10)
    texture = textures.plain(rng, (70, 84, 128))
    yield RenderedObject("book", box(0.12, 0.085, 0.02), texture, book, 0.08)
    texture = textures.banded(rng, (44, 100, 160), (232, 228, 214))
    yield RenderedObject("can", cylinder(0.034, 0.115), texture, placed(-0.13, 0.06, 0.0, -40), 0.45)
    texture = textures.banded(rng, (128, 52, 62), (218, 182, 120))
    yield RenderedObject("tin", cylinder(0.056, 0.17), texture, placed(0.38, 0.2, 0.0, 20), 0.35)
    texture = textures.plain(rng, (226, 178, 64), grain=0.05)
    yield RenderedObject("melon", ellipsoid(0.062, 0.052, 0.05), texture, placed(0.24, 0.0, 0.05, 25), 0.25)
    texture = textures.plain(rng, (232, 126, 38))
    yield RenderedObject("orange", ellipsoid(0.04, 0.04, 0.04), texture, on_book, 0.2)
    texture = textures.plain(rng, (222, 218, 206))
    yield RenderedObject("bowl", bowl(0.105, 0.075), texture, placed(-0.24, -0.14), 0.35)
    texture = textures.striped(rng, (88, 132, 138), (214, 204, 182))
    yield RenderedObject("cushion", cushion(0.15, 0.12, 0.06), texture, placed(0.43, -0.08, 0.0, -12))
    texture = textures.beach_ball(((206, 52, 52), (240, 238, 230), (52, 96, 176), (240, 238, 230)) * 2)
    ball, tilted = ellipsoid(_BALL_RADIUS_M, _BALL_RADIUS_M, _BALL_RADIUS_M), np.eye(4)
    # Shows the ball's sectors rather than its pole.
    tilted[:3, :3] = cv2.Rodrigues(np.array([0.6, 0.0, 0.0]))[0]
    yield RenderedObject(_BALL_NAME, ball, texture, tilted, 0.3)
