"""Scores of a segmentation against a ground truth; pixels that are 0 in either map never count."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

#: Pairs of a segment and a region: 4096 of each, whose table takes 128 MiB.
_PAIRS_MOST = 1 << 24
#: Largest distance of matching boundary pixels.
_TOLERANCE_PX = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Contingency:
    """Contingency table of segments and ground-truth regions, and the scores that follow from it.

    Attributes
    ----------
    pixels : (S, R) int64
        Common pixels: a row for each segment, a column for each region.

    References
    ----------
    .. [1] W. M. Rand, "Objective criteria for the evaluation of clustering methods", JASA 66, 1971.
    .. [2] P. Arbelaez et al., "Contour detection and hierarchical image segmentation", TPAMI 33(5), 2011.
    .. [3] M. Meila, "Comparing clusterings: an axiomatic view", ICML 2005.
    """

    pixels: NDArray[np.int64]

    @classmethod
    def between(cls, labels: NDArray[np.integer], truth: NDArray[np.integer]) -> Self:
        """Count the common pixels of two label maps.

        Parameters
        ----------
        labels, truth : integer arrays of the same shape
            Segments and ground-truth regions; 0 is neither.

        Raises
        ------
        ValueError
            If the shapes differ, a map is not of integers, a label is negative, no pixel is labeled in both
            maps, or there are too many pairs.
        """
        labels, truth = np.asarray(labels), np.asarray(truth)
        if labels.shape != truth.shape:
            raise ValueError(f"expected label maps of the same shape, got {labels.shape} and {truth.shape}")
        for name, image in (("labels", labels), ("truth", truth)):
            if not np.issubdtype(image.dtype, np.integer):
                raise ValueError(f"{name}: expected integers, got {image.dtype}")
            if image.size and image.min() < 0:
                raise ValueError(f"{name}: expected labels from 0, got {image.min()}")
        both = (labels > 0) & (truth > 0)
        if not both.any():
            raise ValueError("expected pixels that are labeled in both maps, got none")
        segment, segments = _numbered(labels[both])
        region, regions = _numbered(truth[both])
        if segments * regions > _PAIRS_MOST:
            raise ValueError(f"{segments} segments and {regions} regions are too many to compare each pair")
        counts = np.bincount(segment * regions + region, minlength=segments * regions)
        return cls(counts.reshape(segments, regions).astype(np.int64))

    @property
    def segment_pixels(self) -> NDArray[np.int64]:
        """The (S,) sizes of the segments."""
        return np.asarray(self.pixels.sum(axis=1))

    @property
    def region_pixels(self) -> NDArray[np.int64]:
        """The (R,) sizes of the ground-truth regions."""
        return np.asarray(self.pixels.sum(axis=0))

    def rand_index(self) -> float:
        """Return the Rand index [1]_: the share of pixel pairs on which both maps agree."""
        together = _pairs(self.pixels)
        in_segments, in_regions = _pairs(self.segment_pixels), _pairs(self.region_pixels)
        everything = _pairs(self.pixels.sum(keepdims=True))
        if everything == 0:
            return 1.0
        return (everything + 2 * together - in_segments - in_regions) / everything

    def region_covering(self) -> float:
        """Return the covering of the ground truth [2]_: each region's best overlap, weighted by its size."""
        best = self._overlaps().max(axis=0)
        return float(best @ self.region_pixels / self.region_pixels.sum())

    def variation_of_information(self) -> float:
        """Return the variation of information [3]_, bits: the sum of both conditional entropies."""
        return self.over_segmentation_bits() + self.under_segmentation_bits()

    def over_segmentation_bits(self) -> float:
        """Return H(segments | regions), bits: how much regions are split."""
        return _conditional_entropy_bits(self.pixels)

    def under_segmentation_bits(self) -> float:
        """Return H(regions | segments), bits: how much regions are merged."""
        return _conditional_entropy_bits(self.pixels.T)

    def found_regions(self, overlap_min: float = 0.5) -> int:
        """Return how many regions have a segment with a larger intersection over union than `overlap_min`."""
        return int((self._overlaps().max(axis=0) > overlap_min).sum())

    def object_iou(self) -> float:
        """Return the mean best overlap of all regions but the largest; NaN if it is the only one.

        The largest is usually the background, which alone gives a map of one segment a good covering.
        """
        if self.pixels.shape[1] < 2:
            return float("nan")
        best = np.delete(self._overlaps().max(axis=0), np.argmax(self.region_pixels))
        return float(best.mean())

    def _overlaps(self) -> NDArray[np.float64]:
        union = self.segment_pixels[:, None] + self.region_pixels[None, :] - self.pixels
        return np.asarray(self.pixels / union)


def _numbered(labels: NDArray[np.integer]) -> tuple[NDArray[np.intp], int]:
    """Return labels renumbered from 0 without gaps, and how many there are."""
    top = int(labels.max())
    if top > 16 * labels.size + (1 << 16):
        values, numbers = np.unique(labels, return_inverse=True)
        return numbers.astype(np.intp), values.size
    used = np.zeros(top + 1, dtype=np.intp)
    used[labels] = 1
    return (np.cumsum(used) - 1)[labels], int(used.sum())


def _pairs(pixels: NDArray[np.int64]) -> int:
    return int(np.sum(pixels * (pixels - 1) // 2))


def _conditional_entropy_bits(pixels: NDArray[np.int64]) -> float:
    """Return the entropy of a pixel's row given its column, bits."""
    p = pixels / pixels.sum()
    ratio = np.divide(p.sum(axis=0, keepdims=True), p, out=np.ones_like(p), where=p > 0)
    return float(np.sum(p * np.log2(ratio)))


class BoundaryScores(NamedTuple):
    """Shares of boundary pixels that are matched; NaN where none count."""

    precision: float
    recall: float


def boundary_scores(labels: NDArray[np.integer], truth: NDArray[np.integer]) -> BoundaryScores:
    """Compare the boundaries of two label maps.

    A boundary pixel has another label than its right or lower neighbor, both being labeled. It is matched
    if a boundary of the other map is within 2 pixels, and does not count if an unlabeled pixel of the other
    map is.

    Parameters
    ----------
    labels, truth : (H, W) integers
        Segments and ground-truth regions; 0 is neither.

    Returns
    -------
    BoundaryScores
        `precision` of the segments' boundaries, `recall` of the ground truth's.

    Raises
    ------
    ValueError
        If the maps are not (H, W) of the same shape.
    """
    labels, truth = np.asarray(labels), np.asarray(truth)
    if labels.ndim != 2 or labels.shape != truth.shape:
        raise ValueError(f"expected two (H, W) label maps of the same shape: {labels.shape}, {truth.shape}")
    found, wanted = _boundaries(labels), _boundaries(truth)
    return BoundaryScores(_share_near(found, wanted, truth > 0), _share_near(wanted, found, labels > 0))


def _boundaries(labels: NDArray[np.integer]) -> NDArray[np.bool_]:
    edges = np.zeros(labels.shape, dtype=np.bool_)
    right, left = labels[:, 1:], labels[:, :-1]
    edges[:, :-1] |= (right != left) & (right > 0) & (left > 0)
    below, above = labels[1:], labels[:-1]
    edges[:-1] |= (below != above) & (below > 0) & (above > 0)
    return edges


def _share_near(edges: NDArray[np.bool_], others: NDArray[np.bool_], known: NDArray[np.bool_]) -> float:
    judged = edges & (_distance(~known) > _TOLERANCE_PX)
    if not judged.any():
        return float("nan")
    return float((_distance(others)[judged] <= _TOLERANCE_PX).mean())


def _distance(targets: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return each pixel's distance to the nearest target, pixels; inf if there is none."""
    if not targets.any():
        return np.full(targets.shape, np.inf, dtype=np.float32)
    distance = cv2.distanceTransform((~targets).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance, dtype=np.float32)
