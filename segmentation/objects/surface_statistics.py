"""Sums over the points of each surface, and what follows from them: its plane, extent and axes."""

import math

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I32, compiled
from nurbseg.segmentation.points.grid import DepthGrid

#: Columns of the sums: the number of points; u, v (from the center of the image, in image widths) and inverse
#: depth with their products; x, y and z with theirs.
COUNT, _U, _V, _D, _UU, _UV, _VV, _UD, _VD, _DD = range(10)
X, Y, Z, _XX, _XY, _XZ, _YY, _YZ, _ZZ = range(10, 19)
#: The number of columns.
SUMS = 19
#: Ridge for the slopes of a plane, so that a row of points has one as well.
_RIDGE = 1e-9


def surface_statistics(labels: NDArray[np.int32], count: int, grid: DepthGrid) -> NDArray[np.float64]:
    """Sum over the points of every surface. The sums of merged surfaces are those of their parts.

    Parameters
    ----------
    labels : (h, w) int32
        Of the grid pixels, 1 to `count`; 0 where there is no point.
    count : int
        Number of labels.
    grid : DepthGrid
        The points.

    Returns
    -------
    (count + 1, 19) float64
        By label and the columns of this module. A label without a pixel has zeros.
    """
    sums = np.zeros((count + 1, SUMS))
    _sum(np.ascontiguousarray(labels), grid.inverse_depth, grid.coordinates_m, sums)
    return sums


@compiled
def _sum(labels: I32, inverse_depth: F32, coordinates_m: F32, sums: F64) -> None:
    height, width = labels.shape
    for r in range(height):
        v = (r - 0.5 * (height - 1)) / width
        for c in range(width):
            d = np.float64(inverse_depth[r, c])
            if labels[r, c] == 0 or not d > 0:
                continue
            own, u = sums[labels[r, c]], (c - 0.5 * (width - 1)) / width
            own[COUNT] += 1.0
            own[_U] += u
            own[_V] += v
            own[_D] += d
            own[_UU] += u * u
            own[_UV] += u * v
            own[_VV] += v * v
            own[_UD] += u * d
            own[_VD] += v * d
            own[_DD] += d * d
            x, y, z = (
                np.float64(coordinates_m[0, r, c]),
                np.float64(coordinates_m[1, r, c]),
                np.float64(coordinates_m[2, r, c]),
            )
            own[X] += x
            own[Y] += y
            own[Z] += z
            own[_XX] += x * x
            own[_XY] += x * y
            own[_XZ] += x * z
            own[_YY] += y * y
            own[_YZ] += y * z
            own[_ZZ] += z * z


@compiled
def plane(sums: F64, camera: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Fit a plane of inverse depth.

    Parameters
    ----------
    sums : (19,) float64
        Of a surface.
    camera : (float, float, float, float)
        Focal lengths along u and v, in image widths, and x / z and y / z at the center of the image.

    Returns
    -------
    x, y, z : float
        Unit normal, toward the camera.
    rms_per_m : float
        Root mean square residual, 1/m.
    """
    n = max(sums[COUNT], 1.0)
    u, v, d = sums[_U] / n, sums[_V] / n, sums[_D] / n
    uu, uv, vv = sums[_UU] / n - u * u + _RIDGE, sums[_UV] / n - u * v, sums[_VV] / n - v * v + _RIDGE
    ud, vd, dd = sums[_UD] / n - u * d, sums[_VD] / n - v * d, sums[_DD] / n - d * d
    determinant = uu * vv - uv * uv
    along_u, along_v = (ud * vv - vd * uv) / determinant, (vd * uu - ud * uv) / determinant
    # In x / z and y / z the plane is d = a x + b y + c; its normal is (a, b, c).
    a, b = along_u * camera[0], along_v * camera[1]
    c = d - a * (camera[2] + u / camera[0]) - b * (camera[3] + v / camera[1])
    length = max(math.sqrt(a * a + b * b + c * c), 1e-12)
    rms = math.sqrt(max(dd - along_u * ud - along_v * vd, 0.0))
    return -a / length, -b / length, -c / length, rms


@compiled
def along(sums: F64, direction: tuple[float, float, float]) -> tuple[float, float]:
    """Return mean and standard deviation of the points along a direction, meters."""
    n, (x, y, z) = max(sums[COUNT], 1.0), direction
    mean = (x * sums[X] + y * sums[Y] + z * sums[Z]) / n
    square = x * x * sums[_XX] + y * y * sums[_YY] + z * z * sums[_ZZ]
    square += 2.0 * (x * y * sums[_XY] + x * z * sums[_XZ] + y * z * sums[_YZ])
    return mean, math.sqrt(max(square / n - mean * mean, 0.0))


@compiled
def extents(sums: F64) -> tuple[float, float, float]:
    """Return the standard deviations of the points along their principal axes, meters, largest last."""
    n = max(sums[COUNT], 1.0)
    x, y, z = sums[X] / n, sums[Y] / n, sums[Z] / n
    xx, xy, xz = sums[_XX] / n - x * x, sums[_XY] / n - x * y, sums[_XZ] / n - x * z
    yy, yz, zz = sums[_YY] / n - y * y, sums[_YZ] / n - y * z, sums[_ZZ] / n - z * z
    # The eigenvalues of a symmetric matrix in closed form, by the angle of its cubic.
    mean = (xx + yy + zz) / 3.0
    square = (xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2.0 * (xy * xy + xz * xz + yz * yz)
    spread = math.sqrt(max(square, 0.0) / 6.0)
    if spread < 1e-12:
        side = math.sqrt(max(mean, 0.0))
        return side, side, side
    a, b, c = (xx - mean) / spread, (yy - mean) / spread, (zz - mean) / spread
    ab, ac, bc = xy / spread, xz / spread, yz / spread
    half = 0.5 * (a * (b * c - bc * bc) - ab * (ab * c - bc * ac) + ac * (ab * bc - b * ac))
    angle = math.acos(min(1.0, max(-1.0, half))) / 3.0
    largest = mean + 2.0 * spread * math.cos(angle)
    least = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    middle = 3.0 * mean - largest - least
    return math.sqrt(max(least, 0.0)), math.sqrt(max(middle, 0.0)), math.sqrt(max(largest, 0.0))
