"""The plane that objects stand on: the floor or table of a frame."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, I64, compiled
from nurbseg.segmentation.config import Up
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree

#: Least share of the measured pixels that a plane has, and number of points it is fitted to.
_SHARE_MIN, _POINTS, _POINTS_MIN = 0.01, 300, 20
#: Fits of a plane, each without the points that were far from the one before.
_FITS = 3
#: A determinant of the normal equations under which points do not determine a plane, and the least cosine
#: between a plane's normal and a ray for its area.
_SINGULAR, _SLANT_MIN = 1e-9, 0.05
#: A surface is a plane if so large a share of its points is within so many times the sensor's noise of it.
_INLIERS, _PLANE_NOISE = 0.85, 3.0
#: Cosine of the largest angle between a level plane and gravity's opposite, 15 degrees.
_LEVEL = np.cos(np.radians(15.0))
#: Without gravity, a plane may be a support if its normal points this much towards the top of the image.
_UP_MIN = 0.25
#: Directions towards the sides of an image.
_SIDES = {
    "top": (0.0, -1.0, 0.0),
    "bottom": (0.0, 1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
}
#: Least area of a plane that may be the support in place of the one found, as a share of that one's.
_RIVAL_AREA = 0.5
#: Planes within this angle (8 degrees) of the support's are level, too.
PARALLEL = np.cos(np.radians(8.0))
#: The support of the frame before may have turned more (25 degrees) where its distance is the same, meters.
_TURNED, SAME_DISTANCE_M = np.cos(np.radians(25.0)), 0.05
#: How much larger another plane must be to replace the support of the frame before.
_KEPT = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """The plane that objects stand on.

    Parameters
    ----------
    normal : (3,) float64
        Upwards, a unit vector in the depth camera's frame.
    camera_height_m : float
        Distance of the camera from the plane, meters.
    found_by : {"gravity", "largest"}
        Whether it is the largest plane across gravity or, where gravity is not known, the largest whose
        normal points towards the top of the image or the side that is stated as up (or the largest at all,
        if there is none).
    levels_m : (L,) float64
        Heights above the plane of the level planes of the frame, its own included, ascending, meters.
    planes : (M, 5) float64
        All planes of the frame, as `planes_of` returns them.
    area : float
        Its own there, or a larger one of which more was seen in a frame before.
    is_sure : bool
        False if another plane may be it: neither gravity nor the side that is up is known, and that plane
        faces another side more than this one faces the top.
    """

    normal: NDArray[np.float64]
    camera_height_m: float
    found_by: Literal["gravity", "largest"]
    levels_m: NDArray[np.float64]
    planes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 5)))
    area: float = 0.0
    is_sure: bool = True

    @property
    def support_from_camera(self) -> NDArray[np.float64]:
        """Transform (4, 4) from the camera's frame to the support's.

        The origin is below the camera, z is up, and x is the camera's x axis along the plane.
        """
        a, b, c = self.normal.tolist()
        # The camera's x axis, or z axis if that is nearly upright, less its part along the normal.
        x = (1 - a * a, -a * b, -a * c) if abs(a) <= 0.9 else (-a * c, -b * c, 1 - c * c)
        length = math.hypot(*x)
        x, y, z = (each / length for each in x)
        return np.array(
            [
                [x, y, z, 0.0],
                [b * z - c * y, c * x - a * z, a * y - b * x, 0.0],
                [a, b, c, self.camera_height_m],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )


def find_support(
    cloud: PointMap,
    tree: SegmentationTree,
    *,
    noise: float,
    gravity: NDArray[np.float64] | None = None,
    side: Up = "auto",
    before: Support | None = None,
) -> Support | None:
    """Find the plane that objects stand on among the surfaces of a frame.

    Parameters
    ----------
    cloud, tree, noise
        As for `planes_of`.
    gravity : (3,) float64, optional
        The direction in which things fall, in the camera's frame.
    side : {"auto", "top", "bottom", "left", "right"}
        The side of the image that is up, where gravity is not known.
    before : Support, optional
        That of the frame before, which is preferred to others of its size. Only what is more upright, and
        larger than it was when most of it was seen, replaces it.

    Returns
    -------
    Support or None
        None if no surface is a plane that can be it, or the one before is out of sight.
    """
    planes = planes_of(cloud, tree, noise)
    up = np.array(_SIDES.get(side, _SIDES["top"])) if gravity is None else -gravity
    fits = planes[:, :3] @ up > (_UP_MIN if gravity is None else _LEVEL)
    rank = planes[:, 4].copy()
    same = np.zeros(len(planes), dtype=np.bool_)
    if before is not None:
        along = planes[:, :3] @ before.normal
        is_near = np.abs(planes[:, 3] - before.camera_height_m) < SAME_DISTANCE_M
        same = (along > PARALLEL) | ((along > _TURNED) & is_near)
        rank[same] *= _KEPT
        if gravity is None:
            # A wall does not replace a table that is hidden, even where the camera looks up at it.
            if before.normal @ up > _UP_MIN:
                fits &= (planes[:, :3] @ up > before.normal @ up) & (planes[:, 4] > _KEPT * before.area)
            fits |= same
    elif gravity is None and not fits.any():
        fits[:] = True
    if not fits.any():
        return None
    index = np.where(fits, rank, 0.0).argmax()
    found = planes[index]
    was_sure = before is not None and before.is_sure and bool(same[index])
    is_level = planes[:, :3] @ found[:3] > PARALLEL
    level = planes[is_level]
    rivals = ~is_level & (planes[:, 4] > _RIVAL_AREA * found[4])
    faced = (planes[rivals, :3] @ np.array(list(_SIDES.values())).T).max(initial=0.0)
    return Support(
        normal=found[:3],
        camera_height_m=float(found[3]),
        found_by="largest" if gravity is None else "gravity",
        levels_m=np.sort(found[3] - level[:, 3]),
        planes=planes,
        area=float(found[4]),
        is_sure=gravity is not None or side != "auto" or was_sure or bool(faced <= found[:3] @ up),
    )


def planes_of(cloud: PointMap, tree: SegmentationTree, noise: float) -> NDArray[np.float64]:
    """Find the planes among the large surfaces of a frame.

    Parameters
    ----------
    cloud : PointMap
        The frame's points.
    tree : SegmentationTree
        Its segments.
    noise : float
        Standard deviation of the sensor's inverse depth, 1/m.

    Returns
    -------
    (M, 5) float64
        Of each the normal, towards the camera, the camera's distance, meters, and the area, m^2 times the
        focal length squared.
    """
    leaves = tree.leaves()
    pixels_min = max(_SHARE_MIN * sum(leaf.pixels.size for leaf in leaves), _POINTS_MIN)
    large = [leaf.pixels for leaf in leaves if leaf.pixels.size >= pixels_min]
    if not large:
        return np.zeros((0, 5))
    samples = [pixels[:: -(-pixels.size // _POINTS)] for pixels in large]
    points = cloud.points_m.reshape(-1, 3).take(np.concatenate(samples), axis=0).astype(np.float64)
    planes = _planes(points, np.cumsum([0, *(sample.size for sample in samples)]), noise)
    planes[:, 4] *= [pixels.size for pixels in large]
    return np.asarray(planes[planes[:, 4] > 0])


@compiled
def _planes(points_m: F64, bounds: I64, noise: float) -> F64:
    """Fit a plane to each set of points: inverse depth is linear in the rays.

    Returns (M, 5) as `planes_of`, with the mean area of a pixel; 0 for what is no plane.
    """
    found = np.zeros((len(bounds) - 1, 5))
    for m in range(len(bounds) - 1):
        points = points_m[bounds[m] : bounds[m + 1]]
        n = len(points)
        w = np.zeros(3)
        off = np.zeros(n)
        limit = np.inf
        for _ in range(_FITS):
            normal_matrix, right = np.zeros((3, 3)), np.zeros(3)
            for i in range(n):
                # w . p = 1, so that w . ray = 1 / z.
                if off[i] < limit:
                    weight = 1.0 / points[i, 2] ** 2
                    for j in range(3):
                        right[j] += weight * points[i, j]
                        for k in range(3):
                            normal_matrix[j, k] += weight * points[i, j] * points[i, k]
            if abs(np.linalg.det(normal_matrix)) < _SINGULAR:
                break
            w[:] = np.linalg.solve(normal_matrix, right)
            for i in range(n):
                p = points[i]
                off[i] = abs(p[0] * w[0] + p[1] * w[1] + p[2] * w[2] - 1.0) / p[2]
            limit = max(_PLANE_NOISE * noise, 2.0 * np.median(off))
        length = np.sqrt((w * w).sum())
        if length == 0 or (off < _PLANE_NOISE * noise).mean() < _INLIERS:
            continue
        normal = -w / length
        found[m, :3], found[m, 3] = normal, 1.0 / length
        for i in range(n):
            p = points[i]
            slant = abs(p[0] * normal[0] + p[1] * normal[1] + p[2] * normal[2])
            slant /= np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
            found[m, 4] += p[2] ** 2 / max(slant, _SLANT_MIN) / n
    return found
