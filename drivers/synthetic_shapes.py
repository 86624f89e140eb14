"""Shapes that rays meet exactly: what the synthetic scene is made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: The three components of points, directions or normals; scalars or arrays that broadcast together.
Components = tuple[Any, Any, Any]


class Shape(ABC):
    """A solid or sheet in its own frame, metres, z upwards.

    Attributes
    ----------
    faces : int
        How many smooth surfaces it has.
    corners_m : (8, 3) float64
        Box around it.
    """

    faces: int = 1
    corners_m: NDArray[np.float64]

    @abstractmethod
    def hit(self, origin: Components, direction: Components) -> tuple[NDArray[np.float32], Any]:
        """Return the multiple of `direction` at which rays first meet the shape, and the face they meet.

        inf where a ray misses; only what lies ahead of the origin counts.
        """

    @abstractmethod
    def surface(self, point: Components, face: Any) -> tuple[Components, Any, Any]:
        """Return the unit normals and the texture coordinates, in [0, 1], of points on the shape."""


def _box_corners(low: tuple[float, ...], high: tuple[float, ...]) -> NDArray[np.float64]:
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


def _dot(a: Components, b: Components) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _ahead(t: Any, hit: Any) -> Any:
    return np.where(hit & (t > 1e-4), t, np.float32(np.inf))


def _at(origin: Components, direction: Components, t: Any, axis: int) -> Any:
    return origin[axis] + t * direction[axis]


class Rectangle(Shape):
    """The part of the plane z = 0 within half a width along x and half a height along y."""

    def __init__(self, half_width_m: float, half_height_m: float) -> None:
        self._half = np.float32(half_width_m), np.float32(half_height_m)
        self.corners_m = _box_corners(
            (-half_width_m, -half_height_m, 0.0), (half_width_m, half_height_m, 0.0)
        )

    def hit(self, origin: Components, direction: Components) -> tuple[NDArray[np.float32], Any]:
        """See `Shape`."""
        t = -origin[2] / _not_zero(direction[2])
        inside = np.abs(_at(origin, direction, t, 0)) <= self._half[0]
        inside &= np.abs(_at(origin, direction, t, 1)) <= self._half[1]
        return _ahead(t, inside), np.uint8(0)

    def surface(self, point: Components, face: Any) -> tuple[Components, Any, Any]:
        """See `Shape`."""
        s, t = (0.5 + 0.5 * point[i] / self._half[i] for i in (0, 1))
        return (np.float32(0), np.float32(0), np.float32(1)), s, 1 - t


class Box(Shape):
    """A cuboid around the origin."""

    faces = 6

    def __init__(self, half_x_m: float, half_y_m: float, half_z_m: float) -> None:
        self._half = np.array([half_x_m, half_y_m, half_z_m], dtype=np.float32)
        half = (half_x_m, half_y_m, half_z_m)
        self.corners_m = _box_corners(tuple(-h for h in half), half)

    def hit(self, origin: Components, direction: Components) -> tuple[NDArray[np.float32], Any]:
        """See `Shape`; a ray enters through the last of the three slabs that it enters."""
        enter: Any = None
        leave: Any = None
        face: Any = None
        for axis in range(3):
            inverse = 1 / _not_zero(direction[axis])
            a = (-self._half[axis] - origin[axis]) * inverse
            b = (self._half[axis] - origin[axis]) * inverse
            first, last = np.minimum(a, b), np.maximum(a, b)
            side = (2 * axis + (a > b)).astype(np.uint8)
            if enter is None:
                enter, leave, face = first, last, side
            else:
                face = np.where(first > enter, side, face)
                enter, leave = np.maximum(enter, first), np.minimum(leave, last)
        return _ahead(enter, enter <= leave), face

    def surface(self, point: Components, face: Any) -> tuple[Components, Any, Any]:
        """See `Shape`."""
        axis, sign = face // 2, np.where(face % 2, np.float32(1), np.float32(-1))
        normal = tuple(np.where(axis == i, sign, np.float32(0)) for i in range(3))
        x, y, z = (0.5 + 0.5 * point[i] / self._half[i] for i in range(3))
        s = np.where(axis == 0, y, x)
        t = np.where(axis == 2, y, z)
        return (normal[0], normal[1], normal[2]), s, 1 - t


class Ellipsoid(Shape):
    """An ellipsoid around the origin; a sphere if its radii are equal."""

    def __init__(self, radius_x_m: float, radius_y_m: float, radius_z_m: float) -> None:
        self._radii = np.array([radius_x_m, radius_y_m, radius_z_m], dtype=np.float32)
        radii = (radius_x_m, radius_y_m, radius_z_m)
        self.corners_m = _box_corners(tuple(-r for r in radii), radii)

    def hit(self, origin: Components, direction: Components) -> tuple[NDArray[np.float32], Any]:
        """See `Shape`."""
        near, _, hits = _sphere_roots(self._scaled(origin), self._scaled(direction))
        return _ahead(near, hits), np.uint8(0)

    def surface(self, point: Components, face: Any) -> tuple[Components, Any, Any]:
        """See `Shape`."""
        x, y, z = self._scaled(point)
        normal = _unit((x / self._radii[0], y / self._radii[1], z / self._radii[2]))
        return normal, 0.5 + np.arctan2(y, x) / np.float32(2 * np.pi), 0.5 - 0.5 * np.clip(z, -1, 1)

    def _scaled(self, components: Components) -> Components:
        x, y, z = (components[i] / self._radii[i] for i in range(3))
        return x, y, z


class Cylinder(Shape):
    """An upright cylinder on the plane z = 0; its faces are the side and the two ends."""

    faces = 3

    def __init__(self, radius_m: float, height_m: float) -> None:
        self._radius, self._height = np.float32(radius_m), np.float32(height_m)
        self.corners_m = _box_corners((-radius_m, -radius_m, 0.0), (radius_m, radius_m, height_m))

    def hit(self, origin: Components, direction: Components) -> tuple[NDArray[np.float32], Any]:
        """See `Shape`."""
        ox, oy, oz = origin
        dx, dy, dz = direction
        a = _not_zero(dx * dx + dy * dy)
        half_b, c = ox * dx + oy * dy, ox * ox + oy * oy - self._radius**2
        inside = half_b * half_b - a * c
        t = (-half_b - np.sqrt(np.maximum(inside, 0))) / a
        height = oz + t * dz
        best = _ahead(t, (inside >= 0) & (height >= 0) & (height <= self._height))
        face = np.zeros(np.shape(best), dtype=np.uint8)
        for number, level in ((1, self._height), (2, np.float32(0))):
            t = (level - oz) / _not_zero(dz)
            x, y = ox + t * dx, oy + t * dy
            t = _ahead(t, x * x + y * y <= self._radius**2)
            face = np.where(t < best, np.uint8(number), face)
            best = np.minimum(best, t)
        return best, face

    def surface(self, point: Components, face: Any) -> tuple[Components, Any, Any]:
        """See `Shape`."""
        x, y = point[0] / self._radius, point[1] / self._radius
        side = face == 0
        up = np.where(face == 1, np.float32(1), np.float32(-1))
        normal = (x * side, y * side, np.where(side, np.float32(0), up))
        around = 0.5 + np.arctan2(y, x) / np.float32(2 * np.pi)
        # The ends show the texture's uppermost row: a plain lid.
        return normal, around, np.where(side, 1 - point[2] / self._height, np.float32(0))


class Bowl(Shape):
    """The lower half of a hollow sphere that stands on z = 0; its faces are the outside and the inside."""

    faces = 2

    def __init__(self, radius_m: float, depth_m: float) -> None:
        self._radius, self._depth = np.float32(radius_m), np.float32(depth_m)
        rim = float(np.sqrt(radius_m**2 - (radius_m - depth_m) ** 2))
        self.corners_m = _box_corners((-rim, -rim, 0.0), (rim, rim, depth_m))

    def hit(self, origin: Components, direction: Components) -> tuple[NDArray[np.float32], Any]:
        """See `Shape`."""
        r = self._radius
        low = (origin[0] / r, origin[1] / r, origin[2] / r - 1)
        near, far, hits = _sphere_roots(low, (direction[0] / r, direction[1] / r, direction[2] / r))
        outer = _ahead(near, hits & (_at(origin, direction, near, 2) <= self._depth))
        inner = _ahead(far, hits & (_at(origin, direction, far, 2) <= self._depth))
        return np.minimum(outer, inner), (inner < outer).astype(np.uint8)

    def surface(self, point: Components, face: Any) -> tuple[Components, Any, Any]:
        """See `Shape`."""
        x, y, z = point[0] / self._radius, point[1] / self._radius, point[2] / self._radius - 1
        sign = np.where(face == 1, np.float32(-1), np.float32(1))
        around = 0.5 + np.arctan2(y, x) / np.float32(2 * np.pi)
        return (x * sign, y * sign, z * sign), around, 1 - point[2] / self._depth


class Cushion(Shape):
    """A freeform sheet z = h(x, y) over a rectangle: a bump with folds, flat at its rim.

    Rays are followed in steps through the slab that holds the sheet, then the crossing is refined.
    """

    _STEPS = 10
    #: Halvings until the sheet is all but straight between the ends, then steps of regula falsi.
    _REFINEMENTS = (True, True, True, False, False, False)

    def __init__(self, half_x_m: float, half_y_m: float, height_m: float, folds: float = 2.5) -> None:
        self._half = np.float32(half_x_m), np.float32(half_y_m)
        self._height, self._folds = np.float32(height_m), np.float32(folds)
        # The folds add a quarter at most; the sheet lies just above what it is put on.
        self._top = np.float32(1.25 * height_m)
        self.corners_m = _box_corners((-half_x_m, -half_y_m, 0.0), (half_x_m, half_y_m, 1.25 * height_m))
        self._slab = Box(half_x_m, half_y_m, 0.625 * height_m)

    def height(self, x: Any, y: Any) -> Any:
        """Return h(x, y), metres."""
        x, y = x / self._half[0], y / self._half[1]
        rim_x, rim_y = np.maximum(1 - x * x, 0), np.maximum(1 - y * y, 0)
        wave = np.sin(self._folds * (x + 0.6 * y) + np.float32(0.7))
        return self._height * rim_x * rim_y * (1 + np.float32(0.25) * wave)

    def hit(self, origin: Components, direction: Components) -> tuple[NDArray[np.float32], Any]:
        """See `Shape`."""
        middle = (origin[0], origin[1], origin[2] - self._top / 2)
        enter, _ = self._slab.hit(middle, direction)
        reached = np.isfinite(enter)
        start = np.where(reached, enter, np.float32(1))
        # A ray leaves through the lower plane or after the diagonal at most.
        diagonal = 2 * float(np.hypot(*self._half)) + float(self._top)
        length = diagonal / np.sqrt(_dot(direction, direction))
        step = np.asarray(length / self._STEPS, dtype=np.float32)
        before, above = start, self._over(origin, direction, start)
        low, high = start, start
        f_low, f_high = above, above
        found = np.zeros(np.shape(start), dtype=np.bool_)
        for _ in range(self._STEPS):
            after = before + step
            below = self._over(origin, direction, after)
            crossing = ~found & (above >= 0) & (below < 0)
            low, high = np.where(crossing, before, low), np.where(crossing, after, high)
            f_low, f_high = np.where(crossing, above, f_low), np.where(crossing, below, f_high)
            found |= crossing
            before, above = after, below
        t = low
        for bisect in self._REFINEMENTS:
            share = np.float32(0.5) if bisect else f_low / _not_zero(f_low - f_high)
            t = low + (high - low) * share
            f = self._over(origin, direction, t)
            over = f >= 0
            low, f_low = np.where(over, t, low), np.where(over, f, f_low)
            high, f_high = np.where(over, high, t), np.where(over, f_high, f)
        x, y = _at(origin, direction, t, 0), _at(origin, direction, t, 1)
        inside = (np.abs(x) < self._half[0]) & (np.abs(y) < self._half[1])
        return _ahead(t, reached & found & inside), np.uint8(0)

    def surface(self, point: Components, face: Any) -> tuple[Components, Any, Any]:
        """See `Shape`; the slopes are central differences over a fifth of a millimetre."""
        x, y, _ = point
        step = np.float32(1e-4)
        slope_x = (self.height(x + step, y) - self.height(x - step, y)) / (2 * step)
        slope_y = (self.height(x, y + step) - self.height(x, y - step)) / (2 * step)
        s, t = 0.5 + 0.5 * x / self._half[0], 0.5 + 0.5 * y / self._half[1]
        return _unit((-slope_x, -slope_y, np.ones_like(slope_x))), s, 1 - t

    def _over(self, origin: Components, direction: Components, t: Any) -> Any:
        x, y, z = (_at(origin, direction, t, axis) for axis in range(3))
        return z - self.height(x, y)


def _not_zero(value: Any) -> Any:
    return np.where(np.abs(value) < 1e-9, np.float32(1e-9), value)


def _unit(vector: Components) -> Components:
    scale = 1 / np.sqrt(_dot(vector, vector))
    return vector[0] * scale, vector[1] * scale, vector[2] * scale


def _sphere_roots(origin: Components, direction: Components) -> tuple[Any, Any, Any]:
    """Return both meetings of a ray with the unit sphere, and whether there are any."""
    a, half_b = _dot(direction, direction), _dot(origin, direction)
    inside = half_b * half_b - a * (_dot(origin, origin) - 1)
    root = np.sqrt(np.maximum(inside, 0))
    return (-half_b - root) / a, (-half_b + root) / a, inside >= 0
