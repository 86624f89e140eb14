"""Where rays meet the shapes of the synthetic scene, and what the shapes are like there.

A shape is a kind and up to four sizes, in its own frame.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled, inlined

RECTANGLE, BOX, ELLIPSOID, CYLINDER, BOWL, CUSHION = range(6)
#: Numbers in the precision of the rays: a plain one would draw all that it meets into double precision.
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_NEVER, _NEAREST, _TINY = np.float32(np.inf), np.float32(1e-4), np.float32(1e-9)
_PER_TURN = np.float32(1 / (2 * np.pi))
#: Steps along a ray through the slab that holds a cushion.
_STEPS = 10
#: Halvings until the cushion is all but straight between the ends, and these with the steps of regula falsi.
_HALVINGS, _REFINEMENTS = 3, 6
#: Share of the folds in a cushion's height, their slant and where they begin.
_WAVE, _SLANT, _SHIFT = np.float32(0.25), np.float32(0.6), np.float32(0.7)
#: Over what a cushion's slope is taken, metres.
_SLOPE_STEP = np.float32(1e-4)


@compiled
def cast(
    kinds: NDArray[np.int64],
    sizes: NDArray[np.float32],
    object_from_camera: NDArray[np.float32],
    windows: NDArray[np.int64],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    depth: NDArray[np.float32],
    objects: NDArray[np.uint8],
    faces: NDArray[np.uint8],
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
            # A loop for each kind, in which the others are left out.
            if kind == RECTANGLE:
                _cast_row(RECTANGLE, size, m, number, *rays, *images)
            elif kind == BOX:
                _cast_row(BOX, size, m, number, *rays, *images)
            elif kind == ELLIPSOID:
                _cast_row(ELLIPSOID, size, m, number, *rays, *images)
            elif kind == CYLINDER:
                _cast_row(CYLINDER, size, m, number, *rays, *images)
            elif kind == BOWL:
                _cast_row(BOWL, size, m, number, *rays, *images)
            else:
                _cast_row(CUSHION, size, m, number, *rays, *images)


@inlined
def _cast_row(
    kind: int, size: Any, m: Any, number: int, x: Any, y: Any, depth: Any, objects: Any, faces: Any
) -> None:
    ox, oy, oz = m[0, 3], m[1, 3], m[2, 3]
    for n in range(depth.size):
        dx = m[0, 0] * x[n] + (m[0, 1] * y[n] + m[0, 2])
        dy = m[1, 0] * x[n] + (m[1, 1] * y[n] + m[1, 2])
        dz = m[2, 0] * x[n] + (m[2, 1] * y[n] + m[2, 2])
        t, face = _meet(kind, size, ox, oy, oz, dx, dy, dz)
        nearer = t < depth[n]
        depth[n] = t if nearer else depth[n]
        objects[n] = np.uint8(number + 1) if nearer else objects[n]
        faces[n] = np.uint8(face) if nearer else faces[n]


@compiled
def surfaces_seen(
    kinds: NDArray[np.int64],
    sizes: NDArray[np.float32],
    object_from_camera: NDArray[np.float32],
    paints: NDArray[np.float32],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    depth: NDArray[np.float32],
    objects: NDArray[np.uint8],
    faces: NDArray[np.uint8],
    normals: NDArray[np.float32],
    places: NDArray[np.float32],
) -> None:
    """Find the normal and the place in the paint of what each pixel shows.

    Parameters
    ----------
    kinds, sizes, object_from_camera, x, y, depth, objects, faces
        See `cast`.
    paints : (S, 4) float32
        First column and row of each shape's paint, and by how many it goes on from there.
    normals : (3, H, W) float32
        Set to unit normals in the camera's frame.
    places : (2, H, W) float32
        Set to columns and rows.
    """
    for row in range(depth.shape[0]):
        first = 0
        while first < depth.shape[1]:
            shown = objects[row, first]
            end = first + 1
            while end < depth.shape[1] and objects[row, end] == shown:
                end += 1
            part = slice(first, end)
            first = end
            normal = normals[0, row, part], normals[1, row, part], normals[2, row, part]
            found = *normal, places[0, row, part], places[1, row, part]
            if shown == 0:
                for each in found:
                    each[:] = _ZERO
                continue
            number = np.int64(shown) - 1
            kind = kinds[number]
            shape = sizes[number], object_from_camera[number], paints[number]
            pixels = x[row, part], y[row, part], depth[row, part], faces[row, part]
            # A loop for each kind, in which the others are left out.
            if kind == RECTANGLE:
                _surfaces_in_row(RECTANGLE, shape, pixels, found)
            elif kind == BOX:
                _surfaces_in_row(BOX, shape, pixels, found)
            elif kind == ELLIPSOID:
                _surfaces_in_row(ELLIPSOID, shape, pixels, found)
            elif kind == CYLINDER:
                _surfaces_in_row(CYLINDER, shape, pixels, found)
            elif kind == BOWL:
                _surfaces_in_row(BOWL, shape, pixels, found)
            else:
                _surfaces_in_row(CUSHION, shape, pixels, found)


@inlined
def _surfaces_in_row(kind: int, shape: Any, pixels: Any, found: Any) -> None:
    (size, m, paint), (x, y, depth, faces) = shape, pixels
    normal_x, normal_y, normal_z, columns, rows = found
    for n in range(depth.size):
        t = depth[n]
        u, v = t * x[n], t * y[n]
        px = m[0, 0] * u + m[0, 1] * v + m[0, 2] * t + m[0, 3]
        py = m[1, 0] * u + m[1, 1] * v + m[1, 2] * t + m[1, 3]
        pz = m[2, 0] * u + m[2, 1] * v + m[2, 2] * t + m[2, 3]
        nx, ny, nz, across, down = _surface(kind, size, px, py, pz, faces[n])
        normal_x[n] = m[0, 0] * nx + m[1, 0] * ny + m[2, 0] * nz
        normal_y[n] = m[0, 1] * nx + m[1, 1] * ny + m[2, 1] * nz
        normal_z[n] = m[0, 2] * nx + m[1, 2] * ny + m[2, 2] * nz
        columns[n] = paint[0] + paint[2] * min(max(across, _ZERO), _ONE)
        rows[n] = paint[1] + paint[3] * min(max(down, _ZERO), _ONE)


@compiled
def hit_each(
    kind: int,
    size: NDArray[np.float32],
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    multiples: NDArray[np.float32],
    faces: NDArray[np.uint8],
) -> None:
    """Find where each ray meets one shape, see `Shape.hit`."""
    for n in range(multiples.size):
        o, d = origins[n], directions[n]
        multiples[n], faces[n] = _meet(kind, size, o[0], o[1], o[2], d[0], d[1], d[2])


@compiled
def surface_of_each(
    kind: int,
    size: NDArray[np.float32],
    points: NDArray[np.float32],
    faces: NDArray[np.uint8],
    found: NDArray[np.float32],
) -> None:
    """Find normals and places in the texture of points on one shape, (N, 5), see `Shape.surface`."""
    for n in range(faces.size):
        found[n] = _surface(kind, size, points[n, 0], points[n, 1], points[n, 2], faces[n])


@inlined
def _meet(kind: int, size: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Return the multiple of the direction at which a ray meets a shape, infinity if not, and the face."""
    if kind == RECTANGLE:
        t, face = -oz / _not_zero(dz), 0
        t = t if (abs(ox + t * dx) <= size[0]) & (abs(oy + t * dy) <= size[1]) else _NEVER
    elif kind == BOX:
        t, leave, face = _box_span(size[0], size[1], size[2], ox, oy, oz, dx, dy, dz)
        t = t if t <= leave else _NEVER
    elif kind == ELLIPSOID:
        a, b, c = size[0], size[1], size[2]
        t, _, meets = _sphere_roots(ox / a, oy / b, oz / c, dx / a, dy / b, dz / c)
        t, face = t if meets else _NEVER, 0
    elif kind == CYLINDER:
        t, face = _meet_cylinder(size[0], size[1], ox, oy, oz, dx, dy, dz)
    elif kind == BOWL:
        t, face = _meet_bowl(size[0], size[1], ox, oy, oz, dx, dy, dz)
    else:
        t = _meet_cushion(size, ox, oy, oz, dx, dy, dz)
        face = 0
    return t if t > _NEAREST else _NEVER, face


@inlined
def _box_span(a: Any, b: Any, c: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Return where a ray enters the last of a box's slabs and leaves the first, and by which face."""
    enter, leave, back = _slab(a, ox, dx)
    face = 0 + back
    first, last, back = _slab(b, oy, dy)
    if first > enter:
        enter, face = first, 2 + back
    leave = min(leave, last)
    first, last, back = _slab(c, oz, dz)
    if first > enter:
        enter, face = first, 4 + back
    return enter, min(leave, last), face


@inlined
def _slab(half: Any, origin: Any, direction: Any) -> Any:
    """Return where a ray enters and leaves a slab, and whether it comes from its upper side."""
    inverse = _ONE / _not_zero(direction)
    low, high = (-half - origin) * inverse, (half - origin) * inverse
    if low > high:
        return high, low, 1
    return low, high, 0


@inlined
def _sphere_roots(ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Return both meetings of a ray with the unit sphere, and whether there are any."""
    a = dx * dx + dy * dy + dz * dz
    half_b = ox * dx + oy * dy + oz * dz
    inside = half_b * half_b - a * (ox * ox + oy * oy + oz * oz - _ONE)
    root = math.sqrt(max(inside, _ZERO))
    return (-half_b - root) / a, (-half_b + root) / a, inside >= _ZERO


@inlined
def _meet_cylinder(radius: Any, height: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    a = _not_zero(dx * dx + dy * dy)
    half_b, c = ox * dx + oy * dy, ox * ox + oy * oy - radius * radius
    inside = half_b * half_b - a * c
    best, face = _NEVER, 0
    if inside >= _ZERO:
        t = (-half_b - math.sqrt(inside)) / a
        z = oz + t * dz
        if t > _NEAREST and _ZERO <= z <= height:
            best = t
        # What passes the endless cylinder by does not meet its ends.
        for end in range(1, 3):
            level = height if end == 1 else _ZERO
            t = (level - oz) / _not_zero(dz)
            x, y = ox + t * dx, oy + t * dy
            if _NEAREST < t < best and x * x + y * y <= radius * radius:
                best, face = t, end
    return best, face


@inlined
def _meet_bowl(radius: Any, depth: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    near, far, meets = _sphere_roots(
        ox / radius, oy / radius, oz / radius - _ONE, dx / radius, dy / radius, dz / radius
    )
    if meets and near > _NEAREST and oz + near * dz <= depth:
        return near, 0
    return far if meets and oz + far * dz <= depth else _NEVER, 1


@inlined
def _meet_cushion(size: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    # The folds add a quarter at most: a slab up to there holds the sheet.
    top = (_ONE + _WAVE) * size[2]
    start, leave, _ = _box_span(size[0], size[1], top / _TWO, ox, oy, oz - top / _TWO, dx, dy, dz)
    if start > leave or start <= _NEAREST:
        return _NEVER
    # A ray leaves through the lower plane or after the diagonal at most.
    diagonal = _TWO * math.sqrt(size[0] * size[0] + size[1] * size[1]) + top
    step = diagonal / math.sqrt(dx * dx + dy * dy + dz * dz) / np.float32(_STEPS)
    low, above = start, _over(size, ox + start * dx, oy + start * dy, oz + start * dz)
    for _ in range(_STEPS):
        if low > leave:
            break
        high = low + step
        below = _over(size, ox + high * dx, oy + high * dy, oz + high * dz)
        if above >= _ZERO and below < _ZERO:
            t = _crossing(size, (ox, oy, oz, dx, dy, dz), low, high, above, below)
            inside = (abs(ox + t * dx) < size[0]) & (abs(oy + t * dy) < size[1])
            return t if inside else _NEVER
        low, above = high, below
    return _NEVER


@inlined
def _crossing(size: Any, ray: Any, low: Any, high: Any, above: Any, below: Any) -> Any:
    """Return where a ray crosses a cushion between two places, of which the first is above it."""
    ox, oy, oz, dx, dy, dz = ray
    t = low
    for n in range(_REFINEMENTS):
        t = low + (high - low) * (_HALF if n < _HALVINGS else above / _not_zero(above - below))
        over = _over(size, ox + t * dx, oy + t * dy, oz + t * dz)
        if over >= _ZERO:
            low, above = t, over
        else:
            high, below = t, over
    return t


@inlined
def _over(size: Any, x: Any, y: Any, z: Any) -> Any:
    """Return by how much a point is over a cushion."""
    return z - _cushion_height(size, x, y)


@inlined
def _cushion_height(size: Any, x: Any, y: Any) -> Any:
    x, y = x / size[0], y / size[1]
    rim = max(_ONE - x * x, _ZERO) * max(_ONE - y * y, _ZERO)
    return size[2] * rim * (_ONE + _WAVE * math.sin(size[3] * (x + _SLANT * y) + _SHIFT))


@inlined
def _surface(kind: int, size: Any, x: Any, y: Any, z: Any, face: int) -> Any:
    """Return the unit normal and the place in the texture, in [0, 1], of a point on a shape."""
    if kind == RECTANGLE:
        nx, ny, nz = _ZERO, _ZERO, _ONE
        s, t = _HALF + _HALF * x / size[0], _HALF - _HALF * y / size[1]
    elif kind == BOX:
        axis, sign = face // 2, _ONE if face % 2 else -_ONE
        nx, ny, nz = sign if axis == 0 else _ZERO, sign if axis == 1 else _ZERO, sign if axis == 2 else _ZERO
        s = _HALF + _HALF * (y / size[1] if axis == 0 else x / size[0])
        t = _HALF - _HALF * (y / size[1] if axis == 2 else z / size[2])
    elif kind == ELLIPSOID:
        x, y, z = x / size[0], y / size[1], z / size[2]
        nx, ny, nz = _unit(x / size[0], y / size[1], z / size[2])
        s, t = _around(x, y), _HALF - _HALF * min(max(z, -_ONE), _ONE)
    elif kind == CYLINDER:
        x, y = x / size[0], y / size[0]
        s = _around(x, y)
        if face == 0:
            nx, ny, nz, t = x, y, _ZERO, _ONE - z / size[1]
        else:
            # The ends show the texture's uppermost row: a plain lid.
            nx, ny, nz, t = _ZERO, _ZERO, _ONE if face == 1 else -_ONE, _ZERO
    elif kind == BOWL:
        sign = -_ONE if face == 1 else _ONE
        x, y = x / size[0], y / size[0]
        nx, ny, nz = sign * x, sign * y, sign * (z / size[0] - _ONE)
        s, t = _around(x, y), _ONE - z / size[1]
    else:
        slope_x = _cushion_height(size, x + _SLOPE_STEP, y) - _cushion_height(size, x - _SLOPE_STEP, y)
        slope_y = _cushion_height(size, x, y + _SLOPE_STEP) - _cushion_height(size, x, y - _SLOPE_STEP)
        nx, ny, nz = _unit(-slope_x, -slope_y, _TWO * _SLOPE_STEP)
        s, t = _HALF + _HALF * x / size[0], _HALF - _HALF * y / size[1]
    return nx, ny, nz, s, t


@inlined
def _around(x: Any, y: Any) -> Any:
    """Return the angle about the z axis as a share of the turn, 0.5 along x."""
    return _HALF + math.atan2(y, x) * _PER_TURN


@inlined
def _unit(x: Any, y: Any, z: Any) -> Any:
    scale = _ONE / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@inlined
def _not_zero(value: Any) -> Any:
    return _TINY if abs(value) < _TINY else value
