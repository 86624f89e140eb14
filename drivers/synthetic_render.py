"""Ray casting of the synthetic scene: depth, ground truth and color as an ideal camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.frame import Intrinsics
from nurbseg.drivers.synthetic_light import grounds_of, shaded
from nurbseg.drivers.synthetic_scene import Scene, SceneObject
from nurbseg.drivers.synthetic_shapes import Components, Rectangle

#: Where there is nothing to see.
_BACKGROUND = (52, 54, 58)


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """What one camera sees.

    Attributes
    ----------
    depth_m : (H, W) float32
        Along the optical axis; inf where there is nothing.
    objects : (H, W) uint8
        Number of the visible object + 1, 0 where there is none.
    faces : (H, W) uint8
        Number of its visible face.
    color : (H, W, 3) uint8 or None
        RGB, if asked for.
    """

    depth_m: NDArray[np.float32]
    objects: NDArray[np.uint8]
    faces: NDArray[np.uint8]
    color: NDArray[np.uint8] | None


class Renderer:
    """Casts a ray through every pixel of one camera.

    Parameters
    ----------
    scene : Scene
        What there is to see.
    camera : Intrinsics
        The camera, with its lens.
    """

    def __init__(self, scene: Scene, camera: Intrinsics) -> None:
        self._scene, self._camera = scene, camera
        rays = camera.rays()
        # The span that the rays of each column and row cover: where a thing's bounds can show.
        self._columns = np.nanmin(rays[..., 0], axis=0), np.nanmax(rays[..., 0], axis=0)
        self._rows = np.nanmin(rays[..., 1], axis=1), np.nanmax(rays[..., 1], axis=1)
        # A pixel whose distortion cannot be undone looks far aside, at nothing.
        self._x, self._y = (np.nan_to_num(rays[..., i], nan=1e6) for i in (0, 1))

    def render(self, world_from_camera: NDArray[np.float64], tick: float, *, color: bool) -> Rendering:
        """Return what the camera sees from a place at a moment."""
        shape = self._x.shape
        depth = np.full(shape, np.inf, dtype=np.float32)
        objects, faces = np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.uint8)
        views: list[_View | None] = []
        for number, each in enumerate(self._scene.objects):
            pose = self._scene.world_from_object(number, tick)
            view = self._view(each, np.linalg.inv(pose) @ world_from_camera)
            views.append(view)
            if view is None:
                continue
            t, face = each.shape.hit(view.origin, view.direction)
            nearer = t < depth[view.window]
            np.copyto(depth[view.window], t, where=nearer)
            np.copyto(objects[view.window], np.uint8(number + 1), where=nearer)
            np.copyto(faces[view.window], face, where=nearer)
        image = self._paint(views, depth, objects, faces, tick) if color else None
        return Rendering(depth, objects, faces, image)

    def _view(self, each: SceneObject, object_from_camera: NDArray[np.float64]) -> _View | None:
        """Return an object's rays in its own frame, for the part of the image that it can be in."""
        corners = np.linalg.inv(object_from_camera) @ np.c_[each.shape.corners_m, np.ones(8)].T
        window = self._window(corners[:3].T)
        if window is None:
            return None
        r = object_from_camera[:3, :3].astype(np.float32)
        x, y = self._x[window], self._y[window]
        dx, dy, dz = (r[i, 0] * x + (r[i, 1] * y + r[i, 2]) for i in range(3))
        ox, oy, oz = object_from_camera[:3, 3].astype(np.float32)
        return _View(window, (ox, oy, oz), (dx, dy, dz))

    def _window(self, corners: NDArray[np.float64]) -> tuple[slice, slice] | None:
        """Return the rows and columns whose rays can meet a box, None if there are none."""
        if (corners[:, 2] < 0.05).any():
            return slice(0, self._camera.height), slice(0, self._camera.width)
        places = corners[:, :2] / corners[:, 2:]
        low, high = places.min(axis=0), places.max(axis=0)
        columns = np.flatnonzero((self._columns[1] >= low[0]) & (self._columns[0] <= high[0]))
        rows = np.flatnonzero((self._rows[1] >= low[1]) & (self._rows[0] <= high[1]))
        if not columns.size or not rows.size:
            return None
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    def _paint(
        self,
        views: list[_View | None],
        depth: NDArray[np.float32],
        objects: NDArray[np.uint8],
        faces: NDArray[np.uint8],
        tick: float,
    ) -> NDArray[np.uint8]:
        image = np.empty((*depth.shape, 3), dtype=np.uint8)
        image[objects == 0] = _BACKGROUND
        grounds = grounds_of(self._scene.seed)
        ball = self._scene.world_from_object(self._scene.ball, tick)
        for number, (each, view) in enumerate(zip(self._scene.objects, views, strict=True)):
            if view is None:
                continue
            mine = objects[view.window] == number + 1
            if not mine.any():
                continue
            # Only the rows and columns that show it.
            window, mine, direction = _trimmed(view, mine)
            t = np.where(mine, depth[window], np.float32(1))
            point = tuple(view.origin[i] + t * direction[i] for i in range(3))
            point = (point[0], point[1], point[2])
            if isinstance(each.shape, Rectangle):
                painted = grounds.painted(number, each, point, ball)
            else:
                pose = self._scene.world_from_object(number, tick)
                painted = shaded(each, pose, point, faces[window], view.origin)
            # OpenCV writes through the view; numpy would broadcast the mask slowly.
            cv2.copyTo(painted, mine.view(np.uint8), image[window])
        # A lens does not draw steps: the slight blur is what antialiasing would give.
        return np.asarray(cv2.GaussianBlur(image, (3, 3), 0.6), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """The rays that may meet an object, in its own frame, and their place in the image."""

    window: tuple[slice, slice]
    origin: Components
    direction: Components


def _trimmed(
    view: _View, mine: NDArray[np.bool_]
) -> tuple[tuple[slice, slice], NDArray[np.bool_], Components]:
    rows, columns = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
    inner = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    top, left = view.window[0].start, view.window[1].start
    window = slice(top + rows[0], top + rows[-1] + 1), slice(left + columns[0], left + columns[-1] + 1)
    dx, dy, dz = (each[inner] for each in view.direction)
    return window, mine[inner], (dx, dy, dz)
