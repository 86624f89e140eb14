"""The shapes of the synthetic scene: where a ray meets one, and the surface there.

To compiled code, a shape is a kind and up to four sizes, in its own frame.
"""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, U8, compiled, inlined

RECTANGLE, BOX, ELLIPSOID, CYLINDER, BOWL, CUSHION = range(6)
KINDS = (RECTANGLE, BOX, ELLIPSOID, CYLINDER, BOWL, CUSHION)
#: Single-precision numbers: a Python number would turn results into double precision.
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_NEVER, _NEAREST, _TINY = np.float32(np.inf), np.float32(1e-4), np.float32(1e-9)
_PER_TURN = np.float32(1 / (2 * np.pi))
#: Steps along a ray through the slab that holds a cushion.
_STEPS = 10
#: Bisections until the cushion is nearly linear between the ends, and these with the steps of regula falsi.
_BISECTIONS, _REFINEMENTS = 3, 6
#: Share of the folds in a cushion's height, their slant and where they begin.
_WAVE, _SLANT, _SHIFT = np.float32(0.25), np.float32(0.6), np.float32(0.7)
#: Over what a cushion's slope is taken, meters.
_SLOPE_STEP = np.float32(1e-4)


class Shape:
    """A solid or sheet in its own frame, meters, z upward, with a box around it from `low` to `high`.

    The `sizes` are what a kind of shape leaves open, up to four numbers, and `faces` is how many smooth
    surfaces it has. `corners_m` are those of the box, (8, 3).
    """

    def __init__(
        self,
        kind: int,
        sizes: tuple[float, ...],
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        faces: int = 1,
    ) -> None:
        self.kind, self.faces = kind, faces
        self.sizes = np.zeros(4, dtype=np.float32)
        self.sizes[: len(sizes)] = sizes
        self.corners_m = np.array(list(itertools.product(*zip(low, high, strict=True))))

    def hit(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Find where rays first meet the shape, ahead of their origins, and which face they meet.

        The rays, (N, 3), are in the shape's frame. Returns (N,) multiples of the directions, inf where a ray
        misses, and (N,) faces.
        """
        multiples, faces = np.empty(len(origins), np.float32), np.empty(len(origins), np.uint8)
        rows = np.ascontiguousarray(origins), np.ascontiguousarray(directions)
        _hit_each(self.kind, self.sizes, *rows, multiples, faces)
        return multiples, faces


def rectangle(half_width_m: float, half_height_m: float) -> Shape:
    """Return the part of the plane z = 0 within half a width along x and half a height along y."""
    half = half_width_m, half_height_m
    return Shape(RECTANGLE, half, (-half_width_m, -half_height_m, 0.0), (*half, 0.0))


def box(half_x_m: float, half_y_m: float, half_z_m: float) -> Shape:
    """Return a cuboid around the origin."""
    half = half_x_m, half_y_m, half_z_m
    return Shape(BOX, half, (-half_x_m, -half_y_m, -half_z_m), half, faces=6)


def ellipsoid(radius_x_m: float, radius_y_m: float, radius_z_m: float) -> Shape:
    """Return an ellipsoid around the origin; a sphere if its radii are equal."""
    radii = radius_x_m, radius_y_m, radius_z_m
    return Shape(ELLIPSOID, radii, (-radius_x_m, -radius_y_m, -radius_z_m), radii)


def cylinder(radius_m: float, height_m: float) -> Shape:
    """Return an upright cylinder on the plane z = 0; its faces are the side and the two ends."""
    low, high = (-radius_m, -radius_m, 0.0), (radius_m, radius_m, height_m)
    return Shape(CYLINDER, (radius_m, height_m), low, high, faces=3)


def bowl(radius_m: float, depth_m: float) -> Shape:
    """Return the lower part of a hollow sphere that stands on z = 0; its faces are outside and inside."""
    rim = float(np.sqrt(radius_m**2 - (radius_m - depth_m) ** 2))
    return Shape(BOWL, (radius_m, depth_m), (-rim, -rim, 0.0), (rim, rim, depth_m), faces=2)


def cushion(half_x_m: float, half_y_m: float, height_m: float, folds: float = 2.5) -> Shape:
    """Return a freeform sheet z = h(x, y) over a rectangle: a bump with folds, flat at its rim.

    With x and y in halves of the rectangle's sides, h is the height times (1 - x^2) (1 - y^2) times
    1 + sin(folds (x + 0.6 y) + 0.7) / 4. Rays are followed in steps through the slab that holds the sheet,
    then the crossing is refined.
    """
    # The folds add a quarter at most; the sheet lies just above what it is put on.
    low, high = (-half_x_m, -half_y_m, 0.0), (half_x_m, half_y_m, 1.25 * height_m)
    return Shape(CUSHION, (half_x_m, half_y_m, height_m, folds), low, high)


@inlined
def intersect(kind: int, size: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
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
        t, face = _hit_cylinder(size[0], size[1], ox, oy, oz, dx, dy, dz)
    elif kind == BOWL:
        t, face = _hit_bowl(size[0], size[1], ox, oy, oz, dx, dy, dz)
    else:
        t = _hit_cushion(size, ox, oy, oz, dx, dy, dz)
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
def _hit_cylinder(radius: Any, height: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
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
def _hit_bowl(radius: Any, depth: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    near, far, meets = _sphere_roots(
        ox / radius, oy / radius, oz / radius - _ONE, dx / radius, dy / radius, dz / radius
    )
    if meets and near > _NEAREST and oz + near * dz <= depth:
        return near, 0
    return far if meets and oz + far * dz <= depth else _NEVER, 1


@inlined
def _hit_cushion(size: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any) -> Any:
    # The folds add a quarter at most: a slab up to there holds the sheet.
    top = (_ONE + _WAVE) * size[2]
    start, leave, _ = _box_span(size[0], size[1], top / _TWO, ox, oy, oz - top / _TWO, dx, dy, dz)
    if start > leave or start <= _NEAREST:
        return _NEVER
    # A ray leaves through the lower plane or after the diagonal at most.
    diagonal = _TWO * math.sqrt(size[0] * size[0] + size[1] * size[1]) + top
    step = diagonal / math.sqrt(dx * dx + dy * dy + dz * dz) / np.float32(_STEPS)
    low, above = start, _height_above(size, ox + start * dx, oy + start * dy, oz + start * dz)
    for _ in range(_STEPS):
        if low > leave:
            break
        high = low + step
        below = _height_above(size, ox + high * dx, oy + high * dy, oz + high * dz)
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
        t = low + (high - low) * (_HALF if n < _BISECTIONS else above / _not_zero(above - below))
        over = _height_above(size, ox + t * dx, oy + t * dy, oz + t * dz)
        if over >= _ZERO:
            low, above = t, over
        else:
            high, below = t, over
    return t


@inlined
def _height_above(size: Any, x: Any, y: Any, z: Any) -> Any:
    """Return by how much a point is over a cushion."""
    return z - _cushion_height(size, x, y)


@inlined
def _cushion_height(size: Any, x: Any, y: Any) -> Any:
    x, y = x / size[0], y / size[1]
    rim = max(_ONE - x * x, _ZERO) * max(_ONE - y * y, _ZERO)
    return size[2] * rim * (_ONE + _WAVE * math.sin(size[3] * (x + _SLANT * y) + _SHIFT))


@inlined
def surface(kind: int, size: Any, x: Any, y: Any, z: Any, face: int) -> Any:
    """Return the unit normal and the texture coordinates, in [0, 1], of a point on a shape."""
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


@compiled
def _hit_each(kind: int, size: F32, origins: F32, directions: F32, multiples: F32, faces: U8) -> None:
    """Find where each ray meets one shape, see `Shape.hit`."""
    for n in range(multiples.size):
        o, d = origins[n], directions[n]
        multiples[n], faces[n] = intersect(kind, size, o[0], o[1], o[2], d[0], d[1], d[2])
