"""The model of merging: what it knows of two surfaces, its boosted trees, and what features add."""

import math
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from nurbseg.common.compiled import F64, I32, compiled, inlined
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


class MergingModel(NamedTuple):
    """Regression trees whose sum is the log odds of two surfaces being one object, for compiled loops.

    Parameters
    ----------
    feature, term : (N,) int32
        Of each node: the feature that decides, and the place of its group in `TERMS`.
    threshold, value : (N,) float64
        The way leads to `low` if the feature is at most the threshold; mean of the leaves below.
    low, high : (N,) int32
        Following nodes; -1 at leaves.
    roots : (T,) int32
        First node of each tree.
    """

    feature: I32
    term: I32
    threshold: F64
    value: F64
    low: I32
    high: I32
    roots: I32


def model_of(nodes: np.ndarray) -> MergingModel:
    """Make a model of its nodes, an array of dtype `NODE` in which every tree begins with its root."""
    terms = [place for place, names in enumerate(GROUPS.values(), start=1) for _ in names]
    low, high = (nodes[name].astype(np.int32) for name in ("low", "high"))
    roots = np.setdiff1d(np.arange(nodes.size), np.concatenate([low, high])).astype(np.int32)
    feature = nodes["feature"].astype(np.int32)
    threshold, value = (nodes[name].astype(np.float64) for name in ("threshold", "value"))
    return MergingModel(feature, np.array(terms, dtype=np.int32)[feature], threshold, value, low, high, roots)


@cache
def merging_model() -> MergingModel:
    """Return the model of the package; docs/merging-model.md says what it was trained on."""
    with files(__package__).joinpath("merging_model.npy").open("rb") as file:
        return model_of(np.load(file))


@compiled
def add_terms(terms: F64, features: F64, model: MergingModel) -> None:
    """Add the terms of the log odds, (len(TERMS),) float64; their sum is that of the leaves.

    A node's feature contributes the change of the mean from the node to the next one on the way [1]_.

    References
    ----------
    .. [1] A. Saabas, "Interpreting random forests", 2014.
    """
    for root in model.roots:
        node = root
        terms[0] += model.value[node]
        while model.low[node] >= 0:
            below = features[model.feature[node]] <= model.threshold[node]
            following = model.low[node] if below else model.high[node]
            terms[model.term[node]] += model.value[following] - model.value[node]
            node = following
