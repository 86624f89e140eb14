"""Shapes that rays meet exactly: what the synthetic scene is made of."""

import itertools

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.synthetic.intersections import BOWL, BOX, CUSHION, CYLINDER, ELLIPSOID, RECTANGLE
from nurbseg.drivers.synthetic.rays import hit_each


class Shape:
    """A solid or sheet in its own frame, metres, z upwards, with a box around it from `low` to `high`.

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
        hit_each(self.kind, self.sizes, *rows, multiples, faces)
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
