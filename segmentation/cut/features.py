"""Feature vectors: normalized CIELab color and position of every point (eq. 1-3)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, U8, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap

_VALUE = np.arange(256) / 255
#: Linear intensity of each of the 256 sRGB values (IEC 61966-2-1).
_LINEAR = np.where(_VALUE <= 0.04045, _VALUE / 12.92, ((_VALUE + 0.055) / 1.055) ** 2.4).astype(np.float32)
#: Linear sRGB to X, Y and Z, relative to the white point D65 (IEC 61966-2-1).
_XYZ = (
    np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
    / np.array([[0.950456], [1.0], [1.088754]])
).astype(np.float32)
#: Intervals of [0, 1] in which CIELab's function of X, Y and Z is interpolated, to 5e-6.
_INTERVALS = 4096
_T = np.arange(_INTERVALS + 2) / _INTERVALS
#: CIELab's function of X, Y or Z at the ends of the intervals and one more, as 1 may be rounded up.
_LAB_FUNCTION = np.where(_T > (6 / 29) ** 3, np.cbrt(_T), _T / (3 * (6 / 29) ** 2) + 4 / 29).astype(
    np.float32
)


@dataclass(frozen=True, slots=True, eq=False)
class Normalization:
    """Normalization of color and position: ``vector = (raw - mean) * factor``.

    Subtracting the mean changes no distance; it keeps single precision accurate far from the camera.

    Parameters
    ----------
    mean : (D,) float32
        Mean of L, a, b (CIELab units), x, y, z (meters) and, where there are normals, their x, y, z.
    factor : (D,) float32
        Each weight over its deviation, three times: 1 / sigma_c, lambda / sigma_g and so on; 0 where the
        deviation is 0.
    """

    mean: NDArray[np.float32]
    factor: NDArray[np.float32]


def lab(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Convert sRGB colors to CIELab (eq. 1).

    Parameters
    ----------
    color : (N, 3) uint8
        RGB.

    Returns
    -------
    (N, 3) float32
        L in 0 to 100, a and b in about -127 to 127, for the white point D65; exact to 0.01.
    """
    # OpenCV's is less exact, and takes a tenth of a second for its tables in every process.
    color = np.ascontiguousarray(color).view()
    # Compiled for one type, whoever calls.
    color.flags.writeable = False
    return _lab(color, _LINEAR, _XYZ, _LAB_FUNCTION)


@compiled
def _lab(color: U8, linear: F32, to_xyz: F32, function: F32) -> F32:
    found, f = np.empty(color.shape, dtype=np.float32), np.empty(3, dtype=np.float32)
    for n in range(color.shape[0]):
        red, green, blue = linear[color[n, 0]], linear[color[n, 1]], linear[color[n, 2]]
        for k in range(3):
            t = to_xyz[k, 0] * red + to_xyz[k, 1] * green + to_xyz[k, 2] * blue
            position = t * np.float32(_INTERVALS)
            i = int(position)
            f[k] = function[i] + (position - np.float32(i)) * (function[i + 1] - function[i])
        found[n, 0] = np.float32(116.0) * f[1] - np.float32(16.0)
        found[n, 1] = np.float32(500.0) * (f[0] - f[1])
        found[n, 2] = np.float32(200.0) * (f[1] - f[2])
    return found


def raw_vectors(cloud: PointMap, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return color and position of some pixels (eq. 1, 2).

    Parameters
    ----------
    cloud : PointMap
        The frame.
    pixels : (N,) intp
        Flat indices of pixels that have a point.

    Returns
    -------
    (N, 6) float32
        L, a, b and x, y, z in meters.
    """
    vectors = np.empty((pixels.size, 6), dtype=np.float32)
    vectors[:, :3] = lab(cloud.color.reshape(-1, 3)[pixels])
    vectors[:, 3:] = cloud.points_m.reshape(-1, 3)[pixels]
    return vectors


def normalization(
    raw: NDArray[np.float32],
    geometry_weight: float,
    *,
    color_weight: float = 1.0,
    normal_weight: float = 1.0,
) -> Normalization:
    """Compute the normalization of color and position (eq. 3), and of normals if given.

    Parameters
    ----------
    raw : (N, 6) or (N, 9) float32
        L, a, b, x, y, z, and the unit normal's x, y, z.
    geometry_weight : float
        The paper's lambda.
    color_weight, normal_weight : float
        Weights of color and normals.

    Returns
    -------
    Normalization
        sigma_c is the mean of the deviations of L, a, b; sigma_g of those of x, y, z.
    """
    return Normalization(*_normalization(raw, (color_weight, geometry_weight, normal_weight)))


@compiled
def _normalization(raw: F32, weights: tuple[float, float, float]) -> tuple[F32, F32]:
    count, dimensions = raw.shape
    mean, factor = np.zeros(dimensions, dtype=np.float32), np.zeros(dimensions, dtype=np.float32)
    if count == 0:
        return mean, factor
    sums, squares = np.zeros(dimensions), np.zeros(dimensions)
    # Relative to the first row, so that a spread much smaller than the values is not lost.
    first = raw[0].astype(np.float64)
    for row in range(count):
        for k in range(dimensions):
            off = raw[row, k] - first[k]
            sums[k] += off
            squares[k] += off * off
    for triple in range(dimensions // 3):
        sigma, size = 0.0, 0.0
        for k in range(3 * triple, 3 * triple + 3):
            offset = sums[k] / count
            mean[k] = first[k] + offset
            size = max(size, abs(first[k] + offset))
            # sigma_c and sigma_g: the mean deviation of each triple.
            sigma += np.sqrt(max(squares[k] / count - offset * offset, 0.0)) / 3.0
        # A deviation at the level of float32 rounding is that of a constant, and must not be amplified.
        rounding = 1e-5 * (1.0 + size) if triple == 0 else 1e-6 * size
        if sigma > rounding:
            factor[3 * triple : 3 * triple + 3] = weights[triple] / sigma
    return mean, factor


def normalized(raw: NDArray[np.float32], scale: Normalization) -> NDArray[np.float32]:
    """Apply a normalization to raw vectors, (N, D) float32 each."""
    return _normalized(raw, scale.mean, scale.factor)


@compiled
def _normalized(raw: F32, mean: F32, factor: F32) -> F32:
    vectors = np.empty_like(raw)
    for n in range(raw.shape[0]):
        for k in range(raw.shape[1]):
            vectors[n, k] = (raw[n, k] - mean[k]) * factor[k]
    return vectors


def features(cloud: PointMap, config: SegmentationConfig) -> NDArray[np.float32]:
    """Build the vector of every point of a frame (eq. 3).

    Parameters
    ----------
    cloud : PointMap
        The frame.
    config : SegmentationConfig
        Its `geometry_weight` is lambda.

    Returns
    -------
    (N, 6) float32
        Lab color over sigma_c, position times lambda over sigma_g, in the order of the valid pixels, with
        the mean of all vectors at zero. A constant color or position gives zeros.

    References
    ----------
    .. [1] G. Pagnutti and P. Zanuttigh, "Scene segmentation based on NURBS surface fitting metrics",
       STAG 2015, section 3.1.
    """
    raw = raw_vectors(cloud, np.flatnonzero(cloud.valid))
    return normalized(raw, normalization(raw, config.geometry_weight))
