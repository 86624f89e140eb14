"""Ray casting of the synthetic scene: depth, ground truth and color as an ideal camera sees them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I64, U8, compiled, inlined, literal_unroll
from nurbseg.common.frame import Intrinsics
from scene.light import LAMP, lit_grounds, shade
from scene.scene import RenderedScene
from scene.shapes import KINDS, RECTANGLE, intersect, surface


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """What one camera sees.

    `depth_m` (H, W) is along the optical axis, inf where there is nothing; `objects` (H, W) holds the number
    of the visible object + 1, 0 where there is none, `faces` (H, W) the number of its visible face.
    `object_from_camera` (S, 4, 4) are the objects' poses.
    """

    depth_m: NDArray[np.float32]
    objects: NDArray[np.uint8]
    faces: NDArray[np.uint8]
    object_from_camera: NDArray[np.float32]


class Renderer:
    """Casts a ray through every pixel of one camera, with its lens."""

    def __init__(self, scene: RenderedScene, camera: Intrinsics) -> None:
        self._scene, self._camera = scene, camera
        self._kinds = np.array([each.shape.kind for each in scene.objects])
        self._sizes = np.stack([each.shape.sizes for each in scene.objects])
        self._shininess = np.array([each.shininess for each in scene.objects], dtype=np.float32)
        corners = np.stack([each.shape.corners_m.T for each in scene.objects])
        self._corners = np.concatenate([corners, np.ones_like(corners[:, :1])], axis=1)
        rays = camera.rays()
        # The span that the rays of each column and row cover: where a thing's bounds can show.
        self._columns = np.nanmin(rays[..., 0], axis=0), np.nanmax(rays[..., 0], axis=0)
        self._rows = np.nanmin(rays[..., 1], axis=1), np.nanmax(rays[..., 1], axis=1)
        # The ray of a pixel whose distortion cannot be undone points far aside, at nothing.
        self._rays = (np.nan_to_num(rays[..., 0], nan=1e6), np.nan_to_num(rays[..., 1], nan=1e6))

    @cached_property
    def _atlas(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """All textures side by side, from which one call takes what a camera sees.

        With them, for each object, the first column and row of its texture and the size less one, (S, 4).
        Made for cameras that ask for color: it takes a moment.
        """
        grounds = lit_grounds(self._scene.seed)
        textures = [grounds.get(n, each.texture) for n, each in enumerate(self._scene.objects)]
        rows, columns = (np.array([texture.shape[axis] for texture in textures]) for axis in (0, 1))
        ends = np.cumsum(columns)
        atlas = np.zeros((rows.max(), ends[-1], 3), dtype=np.uint8)
        for texture, end in zip(textures, ends, strict=True):
            atlas[: texture.shape[0], end - texture.shape[1] : end] = texture
        windows = np.stack([ends - columns, 0 * rows, columns - 1, rows - 1], axis=1)
        return atlas, windows.astype(np.float32)

    def render(self, world_from_camera: NDArray[np.float64], tick: float) -> Rendering:
        """Return what the camera sees from a place at a moment."""
        shape = self._camera.height, self._camera.width
        depth = np.full(shape, np.inf, dtype=np.float32)
        objects, faces = np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.uint8)
        poses = [self._scene.world_from_object(n, tick) for n in range(self._kinds.size)]
        camera_from_object = np.linalg.inv(world_from_camera) @ np.stack(poses)
        windows = np.array([self._window(corner) for corner in camera_from_object @ self._corners])
        object_from_camera = np.linalg.inv(camera_from_object).astype(np.float32)
        _cast(self._kinds, self._sizes, object_from_camera, windows, *self._rays, depth, objects, faces)
        return Rendering(depth, objects, faces, object_from_camera)

    def color(
        self, world_from_camera: NDArray[np.float64], tick: float, seen: Rendering
    ) -> NDArray[np.uint8]:
        """Return the color image, (H, W, 3) RGB, of what the camera sees."""
        shape, runs, points = seen.objects.shape, _runs_of(seen.objects), (*self._rays, seen.depth_m)
        normals, atlas_px = np.empty((3, *shape), dtype=np.float32), np.empty((2, *shape), dtype=np.float32)
        atlas, windows = self._atlas
        scene = self._kinds, self._sizes, seen.object_from_camera, windows
        _surfaces_seen(*scene, *points, seen.objects, seen.faces, runs, normals, atlas_px)
        image = np.empty((*shape, 3), dtype=np.uint8)
        cv2.remap(atlas, atlas_px[0], atlas_px[1], cv2.INTER_LINEAR, dst=image)
        # All in the camera's frame, in which the eye is the origin.
        lamp, up = (world_from_camera[:3, :3].T @ each for each in (LAMP, np.array([0.0, 0.0, 1.0])))
        ball = np.linalg.inv(world_from_camera) @ self._scene.world_from_object(self._scene.ball, tick)[:, 3]
        vectors = np.stack([lamp, up, ball[:3]]).astype(np.float32)
        lengths = np.float32(world_from_camera[2, 3]), np.float32(self._scene.ball_radius_m)
        is_lit = self._kinds == RECTANGLE
        shade(is_lit, self._shininess, vectors, *lengths, *points, seen.objects, runs, normals, image)
        # A lens does not draw steps: the slight blur is what antialiasing would give.
        return np.asarray(cv2.GaussianBlur(image, (3, 3), 0.6), dtype=np.uint8)

    def _window(self, corners: NDArray[np.float64]) -> tuple[int, int, int, int]:
        """Return the rows and columns whose rays can hit the box of (4, 8) corners: firsts and ends."""
        if (corners[2] < 0.05).any():
            return 0, self._camera.height, 0, self._camera.width
        projected = corners[:2] / corners[2]
        low, high = projected.min(axis=1), projected.max(axis=1)
        columns = np.flatnonzero((self._columns[1] >= low[0]) & (self._columns[0] <= high[0]))
        rows = np.flatnonzero((self._rows[1] >= low[1]) & (self._rows[0] <= high[1]))
        if not columns.size or not rows.size:
            return 0, 0, 0, 0
        return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


@compiled
def _cast(
    kinds: I64,
    sizes: F32,
    object_from_camera: F32,
    windows: I64,
    x: F32,
    y: F32,
    depth: F32,
    objects: U8,
    faces: U8,
) -> None:
    """Lower the `depth` to shapes that are met nearer, and write their number + 1 and face.

    A shape has a kind, four sizes, a pose (4, 4) and a window in which it can show: first row, row after the
    last, first column, column after the last. `x` and `y` are the rays' x / z and y / z.
    """
    for number in range(kinds.size):
        kind, size, m = kinds[number], sizes[number], object_from_camera[number]
        top, bottom, left, right = windows[number]
        for row in range(top, bottom):
            part = slice(left, right)
            rays, images = (
                (x[row, part], y[row, part]),
                (depth[row, part], objects[row, part], faces[row, part]),
            )
            for form in literal_unroll(KINDS):
                if form == kind:
                    _cast_row(form, size, m, number, *rays, *images)


@inlined
def _cast_row(
    kind: int, size: Any, m: Any, number: int, x: Any, y: Any, depth: Any, objects: Any, faces: Any
) -> None:
    ox, oy, oz = m[0, 3], m[1, 3], m[2, 3]
    for n in range(depth.size):
        dx = m[0, 0] * x[n] + (m[0, 1] * y[n] + m[0, 2])
        dy = m[1, 0] * x[n] + (m[1, 1] * y[n] + m[1, 2])
        dz = m[2, 0] * x[n] + (m[2, 1] * y[n] + m[2, 2])
        t, face = intersect(kind, size, ox, oy, oz, dx, dy, dz)
        nearer = t < depth[n]
        depth[n] = t if nearer else depth[n]
        objects[n] = np.uint8(number + 1) if nearer else objects[n]
        faces[n] = np.uint8(face) if nearer else faces[n]


def _runs_of(objects: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the row, the first column and the end of each run of pixels that show one object, (R, 3)."""
    begins = np.ones(objects.shape, dtype=np.bool_)
    begins[:, 1:] = objects[:, 1:] != objects[:, :-1]
    first_px = np.flatnonzero(begins)
    rows, firsts = np.divmod(first_px, objects.shape[1])
    return np.stack([rows, firsts, firsts + np.diff(first_px, append=objects.size)], axis=1)


@compiled
def _surfaces_seen(
    kinds: I64,
    sizes: F32,
    object_from_camera: F32,
    atlas_windows: F32,
    x: F32,
    y: F32,
    depth: F32,
    objects: U8,
    faces: U8,
    runs: I64,
    normals: F32,
    atlas_px: F32,
) -> None:
    """Set the `normals` (3, H, W), in the camera's frame, and the columns and rows in the atlas, (2, H, W).

    The windows (S, 4) are the first column and row of each shape's texture there, and the size less one.
    """
    for row, first, end in runs:
        part = slice(first, end)
        normal = normals[0, row, part], normals[1, row, part], normals[2, row, part]
        found = *normal, atlas_px[0, row, part], atlas_px[1, row, part]
        shown = objects[row, first]
        if shown == 0:
            for each in found:
                each[:] = np.float32(0)
            continue
        number = np.int64(shown) - 1
        kind = kinds[number]
        shape = sizes[number], object_from_camera[number], atlas_windows[number]
        pixels = x[row, part], y[row, part], depth[row, part], faces[row, part]
        for form in literal_unroll(KINDS):
            if form == kind:
                _surfaces_in_row(form, shape, pixels, found)


@inlined
def _surfaces_in_row(kind: int, shape: Any, pixels: Any, found: Any) -> None:
    (size, m, window), (x, y, depth, faces) = shape, pixels
    normal_x, normal_y, normal_z, columns, rows = found
    for n in range(depth.size):
        t = depth[n]
        u, v = t * x[n], t * y[n]
        px = m[0, 0] * u + m[0, 1] * v + m[0, 2] * t + m[0, 3]
        py = m[1, 0] * u + m[1, 1] * v + m[1, 2] * t + m[1, 3]
        pz = m[2, 0] * u + m[2, 1] * v + m[2, 2] * t + m[2, 3]
        nx, ny, nz, across, down = surface(kind, size, px, py, pz, faces[n])
        normal_x[n] = m[0, 0] * nx + m[1, 0] * ny + m[2, 0] * nz
        normal_y[n] = m[0, 1] * nx + m[1, 1] * ny + m[2, 1] * nz
        normal_z[n] = m[0, 2] * nx + m[1, 2] * ny + m[2, 2] * nz
        columns[n] = window[0] + window[2] * min(max(across, np.float32(0)), np.float32(1))
        rows[n] = window[1] + window[3] * min(max(down, np.float32(0)), np.float32(1))
