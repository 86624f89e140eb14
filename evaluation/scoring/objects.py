"""How well objects are found: overlap and boundaries of the best one-to-one assignment to true objects."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

#: Least F measure of the overlap at which an object counts as found.
_FOUND_F = 0.75
#: Boundaries match within this distance, a share of the image diagonal.
_TOLERANCE = 0.003
#: A segment is coplanar with the largest if its root mean square distance to the plane is below this, 1/m
#: of inverse depth: three times the usual noise.
_COPLANAR_PER_M = 7.5e-3


class ObjectScores(NamedTuple):
    """Scores of objects against true objects, 0 to 1, greater is better.

    `found` is the share of the true objects whose assigned object has an F measure of at least .75; NaN
    where there is no true object.
    """

    overlap_precision: float
    overlap_recall: float
    overlap_f: float
    boundary_precision: float
    boundary_recall: float
    boundary_f: float
    found: float


def object_scores(objects: NDArray[np.integer], truth: NDArray[np.integer]) -> ObjectScores:
    """Compare objects with true objects.

    Objects are assigned to true ones so that the sum of the F measures of their overlaps is greatest. Over
    all assigned pairs, precision is the common pixels over those of all objects, recall over those of all
    true objects. Boundaries are compared in the same way: pixels near the other boundary count as common.

    Parameters
    ----------
    objects, truth : (H, W) integers
        Labels; 0 is background in both.

    Returns
    -------
    ObjectScores
        Without an object precision is 1, without a true object recall is 1; F is 1 where both are missing.

    Raises
    ------
    ValueError
        If the maps are not (H, W) of the same shape.

    References
    ----------
    .. [1] C. Xie, Y. Xiang, A. Mousavian, D. Fox, "Unseen object instance segmentation for robotic
       environments", IEEE Transactions on Robotics 37(5), 2021, section VI.
    """
    objects, truth = np.asarray(objects), np.asarray(truth)
    if objects.ndim != 2 or objects.shape != truth.shape:
        raise ValueError(f"expected two (H, W) label maps of the same shape: {objects.shape}, {truth.shape}")
    found, of_object = np.unique(objects[objects > 0], return_counts=True)
    true, of_truth = np.unique(truth[truth > 0], return_counts=True)
    common = np.zeros((found.size, true.size), dtype=np.int64)
    both = (objects > 0) & (truth > 0)
    np.add.at(common, (np.searchsorted(found, objects[both]), np.searchsorted(true, truth[both])), 1)
    f = 2.0 * common / np.add.outer(of_object, of_truth)
    rows, columns = linear_sum_assignment(-f)
    agreed = int(common[rows, columns].sum())
    overlap = _precision_recall_f(agreed, int(of_object.sum()), agreed, int(of_truth.sum()))

    radius = int(np.ceil(_TOLERANCE * np.hypot(*objects.shape)))
    offsets = np.arange(-radius, radius + 1)
    disk = (np.add.outer(offsets**2, offsets**2) <= radius**2).astype(np.uint8)
    # As flat indices: a mask of each of thousands of labels would take gigabytes.
    edges = [np.flatnonzero(_boundary(objects == label)) for label in found]
    true_edges = [np.flatnonzero(_boundary(truth == label)) for label in true]

    def near(pixels: NDArray[np.intp]) -> NDArray[np.uint8]:
        mask = np.zeros(objects.shape, dtype=np.uint8)
        mask.ravel()[pixels] = 1
        return cv2.dilate(mask, disk).ravel().astype(np.uint8, copy=False)

    agreeing = true_agreeing = 0
    for row, column in zip(rows, columns, strict=True):
        agreeing += int(near(true_edges[column])[edges[row]].sum())
        true_agreeing += int(near(edges[row])[true_edges[column]].sum())
    boundary = _precision_recall_f(agreeing, sum(map(len, edges)), true_agreeing, sum(map(len, true_edges)))
    share = np.count_nonzero(f[rows, columns] >= _FOUND_F) / true.size if true.size else float("nan")
    return ObjectScores(*overlap, *boundary, share)


def without_background(labels: NDArray[np.integer], points_m: NDArray[np.float32]) -> NDArray[np.integer]:
    """Set the largest segment, and all segments in the same plane, to 0.

    Parameters
    ----------
    labels : (H, W) integers
        Segments; 0 is none.
    points_m : (H, W, 3) float32
        Points, meters; NaN where there is none.
    """
    known = (labels > 0) & (points_m[..., 2] > 0)
    if not known.any():
        return np.zeros_like(labels)
    segments, numbers = np.unique(labels[known], return_inverse=True)
    x, y, z = points_m[known].astype(np.float64).T
    # The inverse depth of a plane is linear in the direction of the ray.
    rays, inverse_depth = np.stack([x / z, y / z, np.ones_like(z)], axis=1), 1.0 / z
    fitted = numbers == np.bincount(numbers).argmax()
    for _ in range(2):
        plane = np.linalg.lstsq(rays[fitted], inverse_depth[fitted], rcond=None)[0]
        distance = np.abs(inverse_depth - rays @ plane)
        fitted &= distance <= 3.0 * np.sqrt(np.mean(distance[fitted] ** 2))
    rms = np.sqrt(np.bincount(numbers, weights=distance**2) / np.bincount(numbers))
    background = rms <= _COPLANAR_PER_M
    background[np.bincount(numbers).argmax()] = True
    return np.where(np.isin(labels, segments[background]), 0, labels)


def _boundary(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the pixels whose right, lower or lower right neighbor is on the other side."""
    edges = np.zeros(mask.shape, dtype=np.uint8)
    edges[:, :-1] |= mask[:, :-1] ^ mask[:, 1:]
    edges[:-1] |= mask[:-1] ^ mask[1:]
    edges[:-1, :-1] |= mask[:-1, :-1] ^ mask[1:, 1:]
    return edges


def _precision_recall_f(
    common: int, objects: int, true_common: int, truth: int
) -> tuple[float, float, float]:
    precision = float(common / objects) if objects else 1.0
    recall = float(true_common / truth) if truth else 1.0
    both = precision + recall
    return precision, recall, 2.0 * precision * recall / both if both else 0.0
