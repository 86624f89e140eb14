"""The paper's text followed literally, as a yardstick: every pixel, double precision, dense systems.

Nystrom normalized cuts keep the affinities of every point to the sample and all eigenvectors; a fit is one
row per point of a dense system, solved by singular value decomposition. Nothing of the fast path's
numerics is used: no decimation, no separable normal equations, no classification by one dot product.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray
from skimage.color import rgb2lab

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.components import remove_small_components
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.bspline import basis_matrices, pixel_knots


def vectors(cloud: PointMap, config: SegmentationConfig) -> NDArray[np.float64]:
    """Eq. 1-3 for every valid pixel, (N, 6)."""
    lab = rgb2lab(cloud.color)[cloud.valid]
    points = cloud.points_m[cloud.valid].astype(float)
    sigma_c = lab.std(axis=0).mean() or 1.0
    sigma_g = points.std(axis=0).mean() or 1.0
    return np.hstack([lab / sigma_c, config.geometry_weight * points / sigma_g])


def cut(x: NDArray[np.float64], config: SegmentationConfig, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Split by the sign of the second eigenvector: one-shot Nystrom of Fowlkes et al., section 3.1.

    What the method leaves open is done as in the fast path, so that both can be compared: which points are
    drawn from a generator, and which part is called 1 (that of the first clear one of these points).
    """
    order = rng.choice(len(x), size=len(x), replace=False)
    m = min(config.samples, len(x) - 1)
    sample, rest = x[order[:m]], x[order[m:]]

    def gaussian(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        distances = np.zeros((len(a), len(b)))
        for axis in range(a.shape[1]):
            distances += (a[:, axis, None] - b[None, :, axis]) ** 2
        return np.exp(-distances / (2 * config.affinity_scale**2))

    A, B = gaussian(sample, sample), gaussian(sample, rest)
    degree_sample = A.sum(axis=1) + B.sum(axis=1)
    degree_rest = B.sum(axis=0) + B.T @ (np.linalg.pinv(A, rcond=1e-6) @ B.sum(axis=1))
    degree = np.maximum(np.concatenate([degree_sample, degree_rest]), 1.0)
    A = A / np.sqrt(np.outer(degree[:m], degree[:m]))
    B = B / np.sqrt(np.outer(degree[:m], degree[m:]))
    values, U = np.linalg.eigh(A)
    kept = values > 1e-6 * values[-1]
    inverse_root = (U[:, kept] / np.sqrt(values[kept])) @ U[:, kept].T
    R = A + inverse_root @ (B @ B.T) @ inverse_root
    L, UR = np.linalg.eigh(R)
    L, UR = L[::-1], UR[:, ::-1]
    positive = L / L[0] > 1e-6
    V = np.vstack([A, B.T]) @ inverse_root @ (UR[:, positive] / np.sqrt(L[positive]))
    side = np.zeros(len(x), dtype=bool)
    if V.shape[1] > 1:
        indicator = V[:, 1] / np.sqrt(degree)
        clear = np.abs(indicator[:m]) >= 0.5 * np.abs(indicator[:m]).max()
        side[order] = indicator * indicator[:m][clear][0] > 0
    return side


def mse(cloud: PointMap, pixels: NDArray[np.intp], config: SegmentationConfig) -> float:
    """Mean squared error of a fit by SVD of the dense system (section 3.2, eq. 7)."""
    height, width = cloud.valid.shape
    rows, columns = np.divmod(pixels, width)
    bases = []
    for places, extent in ((rows, height), (columns, width)):
        size = int(places.max() + 1 - places.min())
        share = config.stag15.control_points_max * size / extent
        count = max(4, min(int(np.floor(share + 0.5)), size))
        parameters = (places - places.min()).astype(float)
        bases.append(basis_matrices(pixel_knots(size, count), 3, parameters)[0])
    system = np.einsum("ka,kb->kab", *bases).reshape(pixels.size, -1)
    points = cloud.points_m.reshape(-1, 3)[pixels].astype(float)
    U, s, Vt = np.linalg.svd(system, full_matrices=False)
    kept = s > 1e-12 * s[0]
    control = Vt[kept].T @ ((U[:, kept].T @ points) / s[kept, None])
    return float(np.square(system @ control - points).sum(axis=1).mean())


def tree(cloud: PointMap, config: SegmentationConfig) -> dict[str, tuple[NDArray[np.intp], float]]:
    """Grow the tree of section 3.3 with the metric MSE: the pixels and the error of each segment, by name."""
    x = vectors(cloud, config)
    everything = np.flatnonzero(cloud.valid)
    row_of = np.zeros(cloud.valid.size, dtype=np.intp)
    row_of[everything] = np.arange(everything.size)
    smallest = config.stag15.segment_pixels_min * cloud.valid.size / (640 * 480)
    segments = {"": (everything, mse(cloud, everything, config))}
    waiting, splits = [(-segments[""][1], "")], 0
    while waiting:
        name = heapq.heappop(waiting)[1]
        pixels, error = segments[name]
        if pixels.size <= 2 * smallest or len(name) >= config.depth_max or splits >= config.splits_max:
            continue  # eq. 6
        rng = np.random.default_rng([config.seed, int(f"1{name}", 2)])
        image, mask = np.zeros(cloud.valid.shape, dtype=bool), np.zeros(cloud.valid.shape, dtype=bool)
        mask.flat[pixels] = True
        image.flat[pixels] = cut(x[row_of[pixels]], config, rng)
        side = remove_small_components(mask, image, smallest).ravel()[pixels]
        parts = pixels[~side], pixels[side]
        if min(part.size for part in parts) < smallest:
            continue
        errors = [mse(cloud, part, config) for part in parts]
        after = sum(value * part.size for value, part in zip(errors, parts, strict=True))
        if name == "" or (error > 0 and after / (error * pixels.size) < config.ratio_max):  # eq. 5
            splits += 1
            for digit, found in enumerate(zip(parts, errors, strict=True)):
                segments[f"{name}{digit}"] = found
                heapq.heappush(waiting, (-found[1], f"{name}{digit}"))
    return segments


def segment(cloud: PointMap, config: SegmentationConfig) -> NDArray[np.uint16]:
    """Label the leaves of `tree` from 1, by name; 0 where there is no depth."""
    segments = tree(cloud, config)
    labels = np.zeros(cloud.valid.size, dtype=np.uint16)
    leaves = sorted(name for name in segments if f"{name}0" not in segments)
    for number, name in enumerate(leaves, start=1):
        labels[segments[name][0]] = number
    return labels.reshape(cloud.valid.shape)
