"""What of an object's box is not seen: down to what it stands on, and the far half of what is rounded."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, I64, compiled, inlined
from nurbseg.library.boxes.boxes import BoxEnds, box_ends
from nurbseg.library.boxes.footprints import STRAY_SHARE, inner_ends
from nurbseg.library.boxes.support import Support

#: An object reaches down to the support where no more than this is missing: meters, and share of its height.
_MISSING_M, _MISSING_SHARE = 0.015, 0.3
#: How far below a level plane the lowest points of what stands on it may lie, meters.
_BELOW_M = 0.01
#: An object is made longer by this share of what is seen of it at most.
LONGER_MAX = 0.6
#: The median distance of what is rounded from an ellipsoid is below this share of that from a box, and this
#: multiple of the sensor's noise.
_CLOSER, _NOISY = 0.6, 3.0
#: The middle of an object as a share of its width, and its near end as a share of what is seen.
_MIDDLE, _NEAR = 0.3, 0.1
#: Sines of the least and the largest angle at which an object is looked down at, and least number of points.
_STEEP, _STEEPEST, _POINTS_MIN = 0.1, 0.99, 10


def standing(support: Support, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lower ends of boxes, brought down to what they stand on if little is missing.

    Parameters
    ----------
    support : Support
        With the level planes of the frame.
    low, high : (M,) float64
        The ends of the boxes along the vertical, meters from the camera.

    Returns
    -------
    (M,) float64
        As `low`.
    """
    bottom, top = low + support.camera_height_m, high + support.camera_height_m
    place = np.searchsorted(support.levels_m, bottom + _BELOW_M, side="right") - 1
    level = support.levels_m[place.clip(0)]
    missing = bottom - level
    stands = missing <= np.maximum(_MISSING_M, _MISSING_SHARE * (top - level))
    # What is as flat as the plane itself stays as it is.
    stands &= (place >= 0) & (top - level > 2 * _BELOW_M)
    return np.where(stands, np.minimum(level, bottom) - support.camera_height_m, low)


@compiled
def vertical_axes(points_m: F64, bounds: I64, up: F64, low: F64, high: F64, noise: float) -> F64:
    """Find the vertical axes of objects that are rounded, as balls and fruit are.

    An object is compared with an ellipsoid and with a box. Both begin where the object is nearest and go up
    to its top; the ellipsoid goes as far back as the last ray that touches it.

    Parameters
    ----------
    points_m, bounds : (N, 3) float64, (M + 1,) int64
        Of objects, as `nurbseg.library.boxes.boxes.box_ends` takes them; the camera is at 0.
    up : (3,) float64
        The vertical, a unit vector.
    low, high : (M,) float64
        The ends of the objects along it, down to what they stand on, meters.
    noise : float
        Standard deviation of the sensor's inverse depth, 1/m.

    Returns
    -------
    (M, 3) float64
        Where the axis is, at the height of the camera, meters; NaN for what is no ellipsoid.
    """
    found = np.full((len(bounds) - 1, 3), np.nan)
    for m in range(len(found)):
        points, top = points_m[bounds[m] : bounds[m + 1]], high[m] - low[m]
        ahead, sine, depth_m = _looking(points, up)
        if sine < _STEEP or sine > _STEEPEST:
            continue
        cosine, across = np.sqrt(1.0 - sine**2), np.cross(up, ahead)
        x, y, z = np.empty(len(points)), np.empty(len(points)), np.empty(len(points))
        count = 0
        for point in points:
            z[count] = _dot(point, up) - low[m]
            if z[count] <= top:
                x[count], y[count] = _dot(point, ahead), _dot(point, across)
                count += 1
        if count < _POINTS_MIN:
            continue
        x, y, z = x[:count], y[:count], z[:count]
        strays = int(STRAY_SHARE * len(z))
        (near, far), (left, right) = inner_ends(x, strays), inner_ends(y, strays)
        # The height at which it is nearest is that of the ellipsoid's center.
        center = min(z[x <= near + _NEAR * (far - near)].mean(), top / 2)
        radius = top - center
        _, touched = inner_ends(x * sine + z * cosine, strays)
        # What touches lies a sin e + sqrt(a^2 sin^2 e + b^2 cos^2 e) beyond the nearest point.
        beyond = touched - near * sine - center * cosine
        if radius <= 0.0 or beyond <= radius * cosine:
            continue
        half = (beyond**2 - (radius * cosine) ** 2) / (2.0 * beyond * sine)
        half = min(half, (1.0 + LONGER_MAX) * (far - near) / 2)
        is_middle = np.abs(y - (left + right) / 2) <= _MIDDLE * (right - left) / 2
        if 2 * half > far - near and _is_rounded(
            x[is_middle] - near - half, z[is_middle] - center, half, radius, _NOISY * noise * depth_m**2
        ):
            found[m] = (near + half) * ahead + (left + right) / 2 * across
    return found


@compiled
def _looking(points_m: F64, up: F64) -> tuple[F64, float, float]:
    """Return the level direction to points, the sine of the angle down to them, and their depth, meters."""
    middle = np.zeros(3)
    for point in points_m:
        middle += point
    middle /= len(points_m)
    height = _dot(middle, up)
    ahead = middle - height * up
    return ahead / max(np.sqrt(_dot(ahead, ahead)), 1e-9), -height / np.sqrt(_dot(middle, middle)), middle[2]


@inlined
def _dot(a: F64, b: F64) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def _is_rounded(x: F64, z: F64, half: float, radius: float, farthest_m: float) -> bool:
    """Return whether points in a vertical plane are closer to an ellipse than to the rectangle around it."""
    if len(x) < _POINTS_MIN:
        return False
    share = np.maximum(np.sqrt((x / half) ** 2 + (z / radius) ** 2), 0.3)
    from_ellipse = np.median(np.abs(share - 1.0) / share * np.sqrt(x**2 + z**2))
    from_sides = np.median(np.minimum(np.abs(x + half), np.abs(z - radius)))
    return bool(from_ellipse < min(_CLOSER * from_sides, farthest_m))


def completed(
    visible: BoxEnds,
    points_m: NDArray[np.float64],
    bounds: NDArray[np.int64],
    support: Support,
    noise: float,
) -> BoxEnds:
    """Return boxes around objects that stand on a support, with what of them is not seen.

    What is rounded is taken to be the same after half a turn about its vertical axis.

    Parameters
    ----------
    visible : BoxEnds
        Of what is seen.
    points_m, bounds : ndarray
        The points, as `box_ends` takes them.
    support, noise : Support, float
        With the level planes of the frame; and as for `vertical_axes`.

    Returns
    -------
    BoxEnds
        Around all of each object. The tops are those that are seen.
    """
    low, up = visible.low.copy(), support.normal
    low[:, 2] = standing(support, low[:, 2], visible.high[:, 2])
    whole = BoxEnds(visible.axes.copy(), low, visible.high.copy(), visible.roundness.copy())
    axes_m = vertical_axes(points_m, bounds, up, low[:, 2], whole.high[:, 2], noise)
    rounded = np.flatnonzero(np.isfinite(axes_m[:, 0]))
    if rounded.size:
        own = [points_m[bounds[n] : bounds[n + 1]] for n in rounded.tolist()]
        turned = [
            2.0 * (axes_m[n] + np.outer(each @ up, up)) - each for n, each in zip(rounded, own, strict=True)
        ]
        both = box_ends(
            np.concatenate([part for pair in zip(own, turned, strict=True) for part in pair]),
            np.cumsum([0, *(2 * len(each) for each in own)]),
            np.tile(up, (rounded.size, 1)),
            noise,
        )
        whole.axes[rounded], whole.roundness[rounded] = both.axes, both.roundness
        whole.low[rounded, :2], whole.high[rounded, :2] = both.low[:, :2], both.high[:, :2]
    return whole
