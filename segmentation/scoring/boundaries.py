"""How well the boundaries between segments lie on those of a ground truth."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray


class BoundaryScores(NamedTuple):
    """Shares of boundary pixels that are matched; NaN where none count."""

    precision: float
    recall: float


def boundary_scores(
    labels: NDArray[np.integer], truth: NDArray[np.integer], *, tolerance_px: float = 2.0
) -> BoundaryScores:
    """Compare the boundaries of two label maps.

    A boundary pixel has another label than its right or lower neighbour, both being labelled. It is matched
    if a boundary of the other map is within the tolerance, and does not count if an unlabelled pixel of the
    other map is.

    Parameters
    ----------
    labels, truth : (H, W) integers
        Segments and ground-truth regions; 0 is neither.
    tolerance_px : float
        Largest distance of a match, pixels.

    Returns
    -------
    BoundaryScores
        `precision` of the segments' boundaries, `recall` of the ground truth's.

    Raises
    ------
    ValueError
        If the maps are not (H, W) of the same shape, or the tolerance is negative.
    """
    labels, truth = np.asarray(labels), np.asarray(truth)
    if labels.ndim != 2 or labels.shape != truth.shape:
        raise ValueError(f"expected two (H, W) label maps of the same shape: {labels.shape}, {truth.shape}")
    if not tolerance_px >= 0:
        raise ValueError(f"tolerance_px: expected at least 0, got {tolerance_px}")
    found, wanted = _boundaries(labels), _boundaries(truth)
    precision = _share_near(found, wanted, truth > 0, tolerance_px)
    recall = _share_near(wanted, found, labels > 0, tolerance_px)
    return BoundaryScores(precision, recall)


def _boundaries(labels: NDArray[np.integer]) -> NDArray[np.bool_]:
    edges = np.zeros(labels.shape, dtype=np.bool_)
    right, left = labels[:, 1:], labels[:, :-1]
    edges[:, :-1] |= (right != left) & (right > 0) & (left > 0)
    below, above = labels[1:], labels[:-1]
    edges[:-1] |= (below != above) & (below > 0) & (above > 0)
    return edges


def _share_near(
    edges: NDArray[np.bool_], others: NDArray[np.bool_], known: NDArray[np.bool_], tolerance_px: float
) -> float:
    judged = edges & (_distance(~known) > tolerance_px)
    if not judged.any():
        return float("nan")
    return float((_distance(others)[judged] <= tolerance_px).mean())


def _distance(targets: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return each pixel's distance to the nearest target, pixels; inf if there is none."""
    if not targets.any():
        return np.full(targets.shape, np.inf, dtype=np.float32)
    distance = cv2.distanceTransform((~targets).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance, dtype=np.float32)
