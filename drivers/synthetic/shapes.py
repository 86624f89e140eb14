"""Shapes that rays meet exactly: what the synthetic scene is made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.synthetic import intersections, rays


class Shape:
    """A solid or sheet in its own frame, metres, z upwards.

    Attributes
    ----------
    kind : int
        Which of the forms it is, for the loops that take many shapes at once.
    sizes : (4,) float32
        What the form leaves open.
    faces : int
        How many smooth surfaces it has.
    corners_m : (8, 3) float64
        Box around it.
    """

    kind: int
    faces: int = 1

    def __init__(self, sizes: tuple[float, ...], low: tuple[float, ...], high: tuple[float, ...]) -> None:
        self.sizes = np.zeros(4, dtype=np.float32)
        self.sizes[: len(sizes)] = sizes
        self.corners_m = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        )

    def hit(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Find where rays first meet the shape.

        Parameters
        ----------
        origins, directions : (N, 3) float32
            The rays, in the shape's frame; directions of any length.

        Returns
        -------
        multiples : (N,) float32
            Of the directions; inf where a ray misses. Only what lies ahead of the origin counts.
        faces : (N,) uint8
            The face that is met.
        """
        multiples, faces = np.empty(len(origins), np.float32), np.empty(len(origins), np.uint8)
        rows = np.ascontiguousarray(origins), np.ascontiguousarray(directions)
        rays.hit_each(self.kind, self.sizes, *rows, multiples, faces)
        return multiples, faces


class Rectangle(Shape):
    """The part of the plane z = 0 within half a width along x and half a height along y."""

    kind = intersections.RECTANGLE

    def __init__(self, half_width_m: float, half_height_m: float) -> None:
        half = half_width_m, half_height_m
        super().__init__(half, (-half_width_m, -half_height_m, 0.0), (*half, 0.0))


class Box(Shape):
    """A cuboid around the origin."""

    kind, faces = intersections.BOX, 6

    def __init__(self, half_x_m: float, half_y_m: float, half_z_m: float) -> None:
        half = half_x_m, half_y_m, half_z_m
        super().__init__(half, tuple(-h for h in half), half)


class Ellipsoid(Shape):
    """An ellipsoid around the origin; a sphere if its radii are equal."""

    kind = intersections.ELLIPSOID

    def __init__(self, radius_x_m: float, radius_y_m: float, radius_z_m: float) -> None:
        radii = radius_x_m, radius_y_m, radius_z_m
        super().__init__(radii, tuple(-r for r in radii), radii)


class Cylinder(Shape):
    """An upright cylinder on the plane z = 0; its faces are the side and the two ends."""

    kind, faces = intersections.CYLINDER, 3

    def __init__(self, radius_m: float, height_m: float) -> None:
        super().__init__((radius_m, height_m), (-radius_m, -radius_m, 0.0), (radius_m, radius_m, height_m))


class Bowl(Shape):
    """The lower part of a hollow sphere that stands on z = 0; its faces are the outside and the inside."""

    kind, faces = intersections.BOWL, 2

    def __init__(self, radius_m: float, depth_m: float) -> None:
        rim = float(np.sqrt(radius_m**2 - (radius_m - depth_m) ** 2))
        super().__init__((radius_m, depth_m), (-rim, -rim, 0.0), (rim, rim, depth_m))


class Cushion(Shape):
    """A freeform sheet z = h(x, y) over a rectangle: a bump with folds, flat at its rim.

    With x and y in halves of the rectangle's sides, h is the height times (1 - x^2) (1 - y^2) times
    1 + sin(folds (x + 0.6 y) + 0.7) / 4. Rays are followed in steps through the slab that holds the sheet,
    then the crossing is refined.
    """

    kind = intersections.CUSHION

    def __init__(self, half_x_m: float, half_y_m: float, height_m: float, folds: float = 2.5) -> None:
        # The folds add a quarter at most; the sheet lies just above what it is put on.
        sizes = half_x_m, half_y_m, height_m, folds
        super().__init__(sizes, (-half_x_m, -half_y_m, 0.0), (half_x_m, half_y_m, 1.25 * height_m))
