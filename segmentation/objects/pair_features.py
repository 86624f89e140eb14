"""The model of merging: what it knows of two surfaces, its boosted trees, and what features add."""

import math
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from nurbseg.common.compiled import F32, F64, I64, U16, U32, compiled, inlined
from nurbseg.segmentation.objects.border_statistics import (
    APART,
    CONCAVE,
    CONCAVITY,
    CONCAVITY_SQUARE,
    CONVEX,
    FIRST_NEARER,
    FIRST_NORMAL,
    POINT,
    SAMPLES,
    SECOND_NEARER,
    SECOND_NORMAL,
    STEP,
    TOUCHING,
)
from nurbseg.segmentation.objects.surface_statistics import COUNT, X, Y, Z, along, extents, plane

#: Features by group, in their order. Of a pair, the smaller surface is meant, or both, unless ``_large`` is
#: added: then it is the larger one, and ``_joint`` is what the two would be together. The support is the
#: largest surface of the frame. What is a length is relative to another one, or to the noise.
GROUPS = {
    # Angle at the border, about radians, its deviation, shares of convex and concave samples; cosines of the
    # angles between mean normals at the border, and between planes.
    "crease": ("concave", "uneven", "convex_share", "concave_share", "border_cosine", "plane_cosine"),
    # Share of touching samples; distance in gaps, with a sign; shares where one is nearer; how far the center
    # of one is in front of the other's plane.
    "gap": ("touching", "apart", "step", "nearer", "nearer_large", "front", "front_large"),
    # Logarithm of the length; shares of all borders of a surface; length over the root of the size.
    "border": ("length", "enclosed", "enclosed_large", "compact"),
    # Logarithms of sizes, in pixels of a 640-wide image.
    "size": ("pixels", "pixels_large"),
    # Logarithms of residuals on a plane in noise deviations, and how much larger they are on a joint one.
    "flatness": ("flat", "flat_large", "flat_joint", "flat_loss"),
    # Ratios of extents along principal axes, of one to the other, and of the distance of centers to them.
    "shape": (
        *("thin", "narrow", "thin_large", "narrow_large", "thin_joint", "narrow_joint"),
        *("distance", "extent", "extent_joint", "height_share"),
    ),
    # Heights over the plane of the support: of centers and the border, extents, and relations of these.
    "height": (
        *("height", "height_large", "height_border", "tall", "tall_large", "above"),
        *("border_in", "border_in_large", "above_relative"),
    ),
    # Cosines of planes and of normals at the border with the normal of the support.
    "orientation": ("upright", "upright_large", "upright_joint", "upright_border", "upright_border_large"),
}
NAMES = tuple(name for names in GROUPS.values() for name in names)
FEATURES = len(NAMES)

#: Limit of heights relative to extents.
_RELATIVE_MOST = 5.0


class Scene(NamedTuple):
    """What features of all pairs of a frame share.

    Parameters
    ----------
    camera : (float, float, float, float)
        Focal lengths along u and v, in image widths, and x / z and y / z at the center of the image.
    unit_px : float
        Pixels of this image per pixel of a 640-wide one.
    grid_px : float
        Distance of grid pixels, pixels of a 640-wide image.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m.
    up : (float, float, float)
        Unit normal of the plane of the support.
    level_m : float
        Mean of the support's points along it, meters.
    """

    camera: tuple[float, float, float, float]
    unit_px: float
    grid_px: float
    noise_per_m: float
    up: tuple[float, float, float]
    level_m: float


@inlined
def _share(part: float, whole: float) -> float:
    return part / whole if whole > 0.0 else 0.0


@inlined
def _cosine(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    product = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    squares = (a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    return _share(product, math.sqrt(squares))


@inlined
def _within(value: float, most: float) -> float:
    return max(-most, min(value, most))


@compiled
def pair_features(
    found: F64,
    border: F64,
    surfaces: tuple[F64, F64],
    lengths: tuple[float, float],
    scene: Scene,
) -> None:
    """Compute the features of a pair.

    Parameters
    ----------
    found : (FEATURES,) float64
        Receives them, in the order of `NAMES`.
    border : (19,) float64
        Sums along their border, see `BorderStatistics`.
    surfaces : ((19,) float64, (19,) float64)
        Sums over the points of the first and the second.
    lengths : (float, float)
        Samples of all borders of each.
    scene : Scene
        Of the frame.
    """
    camera, noise, up = scene.camera, scene.noise_per_m, scene.up
    first_larger = surfaces[0][COUNT] > surfaces[1][COUNT]
    small, large = (surfaces[1], surfaces[0]) if first_larger else (surfaces[0], surfaces[1])
    length, length_large = (lengths[1], lengths[0]) if first_larger else (lengths[0], lengths[1])
    joint = small + large
    samples, touching = max(border[SAMPLES], 1.0), max(border[TOUCHING], 1.0)
    nearer, nearer_large = (SECOND_NEARER, FIRST_NEARER) if first_larger else (FIRST_NEARER, SECOND_NEARER)
    k, k_large = (SECOND_NORMAL, FIRST_NORMAL) if first_larger else (FIRST_NORMAL, SECOND_NORMAL)
    normal = (border[k], border[k + 1], border[k + 2])
    normal_large = (border[k_large], border[k_large + 1], border[k_large + 2])
    x, y, z, rms = plane(small, camera)
    x_large, y_large, z_large, rms_large = plane(large, camera)
    x_joint, y_joint, z_joint, rms_joint = plane(joint, camera)
    flat, flat_large, flat_joint = (x, y, z), (x_large, y_large, z_large), (x_joint, y_joint, z_joint)
    n, n_large = max(small[COUNT], 1.0), max(large[COUNT], 1.0)
    between = (
        small[X] / n - large[X] / n_large,
        small[Y] / n - large[Y] / n_large,
        small[Z] / n - large[Z] / n_large,
    )
    depth, depth_large = max(small[Z] / n, 1e-3), max(large[Z] / n_large, 1e-3)

    # The crease.
    concavity = border[CONCAVITY] / touching
    found[0] = _within(concavity, 1.0)
    found[1] = min(math.sqrt(max(border[CONCAVITY_SQUARE] / touching - concavity * concavity, 0.0)), 1.0)
    found[2], found[3] = border[CONVEX] / touching, border[CONCAVE] / touching
    found[4], found[5] = _cosine(normal, normal_large), _cosine(flat, flat_large)
    # The gap.
    found[6], found[7] = border[TOUCHING] / samples, border[APART] / samples
    found[8] = (-border[STEP] if first_larger else border[STEP]) / samples
    found[9], found[10] = border[nearer] / samples, border[nearer_large] / samples
    before = between[0] * flat_large[0] + between[1] * flat_large[1] + between[2] * flat_large[2]
    behind = between[0] * flat[0] + between[1] * flat[1] + between[2] * flat[2]
    found[11] = math.asinh(before / (noise * depth * depth))
    found[12] = math.asinh(-behind / (noise * depth_large * depth_large))
    # The border. Sizes are those of grid pixels.
    found[13] = math.log(samples / scene.unit_px)
    found[14], found[15] = samples / max(length, 1.0), samples / max(length_large, 1.0)
    found[16] = samples / scene.unit_px / (math.sqrt(n) * scene.grid_px)
    # Sizes.
    grid_pixels = scene.grid_px * scene.grid_px
    found[17], found[18] = math.log(n * grid_pixels), math.log(n_large * grid_pixels)
    # Flatness.
    found[19], found[20] = math.log(0.3 + rms / noise), math.log(0.3 + rms_large / noise)
    found[21] = math.log(0.3 + rms_joint / noise)
    apart = (n * rms * rms + n_large * rms_large * rms_large) / (n + n_large)
    found[22] = math.log((rms_joint * rms_joint + noise * noise) / (apart + noise * noise))
    # Shape.
    thin, narrow, long = extents(small)
    thin_large, narrow_large, long_large = extents(large)
    thin_joint, narrow_joint, long_joint = extents(joint)
    found[23], found[24] = _share(thin, long), _share(narrow, long)
    found[25], found[26] = _share(thin_large, long_large), _share(narrow_large, long_large)
    found[27], found[28] = _share(thin_joint, long_joint), _share(narrow_joint, long_joint)
    distance = math.sqrt(between[0] ** 2 + between[1] ** 2 + between[2] ** 2)
    found[29] = distance / max(long + long_large, 1e-6)
    found[30], found[31] = _share(long, long_large), _share(long_joint, long_large)
    # Heights over the support.
    height, tall = along(small, up)
    height_large, tall_large = along(large, up)
    _, tall_joint = along(joint, up)
    height_border = up[0] * border[POINT] + up[1] * border[POINT + 1] + up[2] * border[POINT + 2]
    height_border /= samples
    found[32] = _share(tall_joint, long_joint)
    noise_m = noise * max(depth, depth_large) ** 2
    found[33] = math.asinh((height - scene.level_m) / noise_m)
    found[34] = math.asinh((height_large - scene.level_m) / noise_m)
    found[35] = math.asinh((height_border - scene.level_m) / noise_m)
    found[36], found[37] = math.asinh(tall / noise_m), math.asinh(tall_large / noise_m)
    found[38] = math.asinh((height - height_large) / noise_m)
    found[39] = _within((height_border - height) / max(tall, noise_m), _RELATIVE_MOST)
    found[40] = _within((height_border - height_large) / max(tall_large, noise_m), _RELATIVE_MOST)
    found[41] = _within((height - height_large) / max(tall + tall_large, noise_m), _RELATIVE_MOST)
    # Orientation.
    found[42], found[43], found[44] = _cosine(flat, up), _cosine(flat_large, up), _cosine(flat_joint, up)
    found[45], found[46] = _cosine(normal, up), _cosine(normal_large, up)


#: Terms of the log odds: a constant, then what each group of features adds.
TERMS = ("base", *GROUPS)
#: Fields of a node: feature, threshold, nodes at or below and above it, and value. A leaf has no nodes below
#: it (-1) and is a part of the log odds; other nodes have the mean of the leaves below them.
NODE = np.dtype([("feature", "u1"), ("threshold", "f4"), ("low", "i2"), ("high", "i2"), ("value", "f4")])
#: Leaves that a tree can have: the bits of a mask.
LEAVES_MAX = 32
_ALL_LEAVES = (1 << LEAVES_MAX) - 1
#: Number of the lowest bit of a mask, by the highest five bits of that bit's product with a de Bruijn
#: sequence.
_DE_BRUIJN = 0x077CB531
_LOWEST_BIT = np.argsort([(_DE_BRUIJN << bit & _ALL_LEAVES) >> 27 for bit in range(LEAVES_MAX)])


class MergingModel(NamedTuple):
    """Regression trees whose sum is the log odds of two surfaces being one object, for compiled loops.

    Nodes are in the order of features and thresholds, so that the ones whose threshold a feature exceeds can
    be passed in a row [1]_: each takes leaves from its tree, and the first that is left is the one that the
    features lead to.

    Parameters
    ----------
    feature_end : (FEATURES,) int64
        Number of nodes up to and with those of each feature.
    threshold : (N,) float32
        Of each node, ascending within a feature.
    tree : (N,) uint16
        To which it belongs.
    leaves : (N,) uint32
        Bits of the leaves of its tree that remain if the feature is above; bit 0 is the leaf that is reached
        if every feature is below.
    first_leaf : (T,) int64
        Number of the first leaf of each tree.
    leaf_terms : (L, len(TERMS)) float64
        What each leaf adds: as the constant the mean of its tree, and for each group of features the changes
        of the mean at its decisions [2]_.
    base : float
        The constant.

    References
    ----------
    .. [1] C. Lucchese et al., "QuickScorer: a fast algorithm to rank documents with additive ensembles of
       regression trees", SIGIR 2015.
    .. [2] A. Saabas, "Interpreting random forests", 2014.
    """

    feature_end: I64
    threshold: F32
    tree: U16
    leaves: U32
    first_leaf: I64
    leaf_terms: F64
    base: float


def model_of(nodes: np.ndarray) -> MergingModel:
    """Make a model of its nodes, an array of dtype `NODE` in which every tree begins with its root.

    Raises
    ------
    ValueError
        If a tree has more than `LEAVES_MAX` leaves.
    """
    term_of = [place for place, names in enumerate(GROUPS.values(), start=1) for _ in names]
    roots = np.setdiff1d(np.arange(nodes.size), np.concatenate([nodes["low"], nodes["high"]]))
    first_leaf: list[int] = []
    leaf_terms: list[list[float]] = []
    decisions: list[tuple[int, float, int, int]] = []

    def add(node: int, terms: list[float]) -> int:
        """Add what is below a node, whose leaves have these terms; return its leaves as bits."""
        feature, threshold, low, high, value = nodes[node].item()
        if low < 0:
            leaf_terms.append(terms)
            return 1 << (len(leaf_terms) - 1 - first_leaf[-1])
        below = []
        for following in (low, high):
            changed = terms.copy()
            changed[term_of[feature]] += nodes["value"][following].item() - value
            below.append(add(following, changed))
        decisions.append((feature, threshold, len(first_leaf) - 1, _ALL_LEAVES & ~below[0]))
        return below[0] | below[1]

    for root in roots.tolist():
        first_leaf.append(len(leaf_terms))
        add(root, [nodes["value"][root].item()] + [0.0] * len(GROUPS))
    if np.diff([*first_leaf, len(leaf_terms)]).max() > LEAVES_MAX:
        raise ValueError(f"a tree has more than {LEAVES_MAX} leaves")
    decisions.sort()
    feature, threshold, tree, leaves = np.array(decisions, dtype=np.float64).reshape(-1, 4).T
    return MergingModel(
        np.searchsorted(feature, np.arange(FEATURES), side="right"),
        threshold.astype(np.float32),
        tree.astype(np.uint16),
        leaves.astype(np.uint32),
        np.array(first_leaf),
        np.array(leaf_terms),
        float(nodes["value"][roots].sum(dtype=np.float64)),
    )


@cache
def merging_model() -> MergingModel:
    """Return the model of the package; docs/merging-model.md says what it was trained on."""
    with files(__package__).joinpath("merging_model.npy").open("rb") as file:
        return model_of(np.load(file))


@compiled
def add_terms(terms: F64, features: F64, model: MergingModel) -> None:
    """Add the terms of the log odds, (len(TERMS),) float64; their sum is that of the leaves."""
    left, node = np.full(model.first_leaf.size, np.uint32(_ALL_LEAVES)), 0
    for feature in range(FEATURES):
        value, end = features[feature], model.feature_end[feature]
        # A feature that is not a number is at most nothing, and so above everything.
        while node < end and not value <= model.threshold[node]:
            left[model.tree[node]] &= model.leaves[node]
            node += 1
        node = end
    for tree in range(left.size):
        bits = np.int64(left[tree])
        leaf = model.first_leaf[tree] + _LOWEST_BIT[((bits & -bits) * _DE_BRUIJN & _ALL_LEAVES) >> 27]
        for k in range(terms.size):
            terms[k] += model.leaf_terms[leaf, k]
