"""The rays of a camera cast at the shapes of the synthetic scene, row by row."""

from typing import Any

import numpy as np
from numba import literal_unroll

from nurbseg.drivers.compiled import F32, I64, U8, compiled, inlined
from nurbseg.drivers.synthetic.shapes import KINDS, intersect, surface


@compiled
def cast(
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
    """Cast the rays of a camera at many shapes, each within its window of rows and columns.

    Parameters
    ----------
    kinds, sizes, object_from_camera, windows : (S,) int64, (S, 4) float32, (S, 4, 4) float32, (S, 4) int64
        The shapes, their poses, and first row, row after the last, first column, column after the last.
    x, y : (H, W) float32
        The rays' x / z and y / z.
    depth : (H, W) float32
        Along the optical axis, metres; lowered to what is met nearer.
    objects, faces : (H, W) uint8
        Number of the shape that is met + 1, and its face; written where it is nearer.
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


@compiled
def runs_of(objects: U8) -> I64:
    """Return the row, the first column and the end of each run of pixels that show one object, (R, 3)."""
    height, width = objects.shape
    runs = np.empty((height * width, 3), dtype=np.int64)
    count = 0
    for row in range(height):
        for column in range(width):
            if column == 0 or objects[row, column] != objects[row, column - 1]:
                runs[count, 0], runs[count, 1] = row, column
                count += 1
            runs[count - 1, 2] = column + 1
    return runs[:count]


@compiled
def surfaces_seen(
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
    """Find the normal and the texture coordinates of what each pixel shows.

    Parameters
    ----------
    kinds, sizes, object_from_camera, x, y, depth, objects, faces
        See `cast`.
    atlas_windows : (S, 4) float32
        First column and row of each shape's texture in the atlas, and the size less one.
    runs : (R, 3) int64
        See `runs_of`.
    normals : (3, H, W) float32
        Set to unit normals in the camera's frame.
    atlas_px : (2, H, W) float32
        Set to columns and rows.
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
