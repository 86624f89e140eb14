"""Features of pairs of surfaces by their definitions, from the points themselves."""

import math
from itertools import combinations

import numpy as np
import pytest

from nurbseg.segmentation.objects import border_statistics as border
from nurbseg.segmentation.objects.agglomeration import scene_of
from nurbseg.segmentation.objects.pair_features import FEATURES, NAMES, pair_features
from nurbseg.segmentation.objects.surface_statistics import COUNT, surface_statistics
from nurbseg.segmentation.points.grid import depth_grid

NOISE_PER_M = 2e-3


@pytest.fixture
def surfaces(cloud_of, box_on_table):
    """A box on a table: its grid, labels on the grid, and sums over the points."""
    depth, truth = box_on_table(noise_per_m=NOISE_PER_M)
    grid = depth_grid(cloud_of(depth), 2)
    on_grid = np.ascontiguousarray(truth[::2, ::2])
    return grid, on_grid, surface_statistics(on_grid, 4, grid)


def made_up_border(seed):
    rng = np.random.default_rng(seed)
    own = np.zeros(border.SUMS)
    samples, touching = 60, 40
    turns = rng.normal(0.1, 0.4, touching)
    gaps = rng.normal(0.3, 1.5, samples)
    own[border.SAMPLES], own[border.TOUCHING] = samples, touching
    own[border.CONCAVITY], own[border.CONCAVITY_SQUARE] = turns.sum(), np.square(turns).sum()
    own[border.CONVEX], own[border.CONCAVE] = 7, 21
    own[border.APART], own[border.STEP] = np.abs(gaps).sum(), gaps.sum()
    own[border.FIRST_NEARER], own[border.SECOND_NEARER] = 12, 5
    own[border.POINT :] = rng.normal(size=9) * samples
    return own


def found_of(surfaces, one, other, own, *, lengths=(200.0, 300.0)):
    grid, _, sums = surfaces
    found = np.empty(FEATURES)
    pair = (sums[one], sums[other])
    pair_features(found, own, pair, lengths, scene_of(sums, grid, NOISE_PER_M))
    return dict(zip(NAMES, found.tolist(), strict=True))


def plane_of(grid, mask):
    """Unit normal toward the camera and residual of the plane of inverse depth through some points."""
    points = grid.coordinates_m[:, mask].astype(float)
    d = grid.inverse_depth[mask].astype(float)
    rays = points / points[2]
    n = np.linalg.lstsq(rays.T, d, rcond=None)[0]
    return -n / np.linalg.norm(n), float(np.sqrt(np.mean((n @ rays - d) ** 2)))


@pytest.mark.parametrize("pair", list(combinations(range(1, 5), 2)))
def test_features_are_what_they_are_defined_to_be(surfaces, pair):
    grid, labels, _ = surfaces
    own = made_up_border(sum(pair))
    found = found_of(surfaces, *pair, own)
    small, large = sorted(pair, key=lambda label: np.count_nonzero(labels == label))
    turned = small != pair[0]
    masks = {"": labels == small, "_large": labels == large, "_joint": np.isin(labels, pair)}
    points = {key: grid.coordinates_m[:, mask].astype(float) for key, mask in masks.items()}
    normals, rms = {}, {}
    for key, mask in masks.items():
        normals[key], rms[key] = plane_of(grid, mask)
    up = plane_of(grid, labels == 1)[0]
    level = (up @ grid.coordinates_m[:, labels == 1].astype(float)).mean()
    pixels = {key: mask.sum() for key, mask in masks.items()}
    axes = {
        key: np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(p, bias=True)), 0)) for key, p in points.items()
    }
    centers = {key: p.mean(axis=1) for key, p in points.items()}
    heights = {key: up @ p for key, p in points.items()}
    between = centers[""] - centers["_large"]
    noise_m = NOISE_PER_M * max(centers[""][2], centers["_large"][2]) ** 2
    at_border = up @ own[border.POINT : border.POINT + 3] / 60
    first, second = own[border.FIRST_NORMAL : border.FIRST_NORMAL + 3], own[border.SECOND_NORMAL :]
    side, side_large = (second, first) if turned else (first, second)
    length, length_large = (300.0, 200.0) if turned else (200.0, 300.0)

    def cosine(a, b):
        return a @ b / np.linalg.norm(a) / np.linalg.norm(b)

    # An image of 320 columns, of which every second is on the grid.
    unit, grid_px = 320 / 640, 2 / (320 / 640)
    mean = own[border.CONCAVITY] / 40
    weighed = (pixels[""] * rms[""] ** 2 + pixels["_large"] * rms["_large"] ** 2) / pixels["_joint"]
    expected = {
        "concave": mean,
        "uneven": math.sqrt(own[border.CONCAVITY_SQUARE] / 40 - mean**2),
        "convex_share": 7 / 40,
        "concave_share": 21 / 40,
        "border_cosine": cosine(first, second),
        "plane_cosine": normals[""] @ normals["_large"],
        "touching": 40 / 60,
        "apart": own[border.APART] / 60,
        "step": (-1 if turned else 1) * own[border.STEP] / 60,
        "nearer": (5 if turned else 12) / 60,
        "nearer_large": (12 if turned else 5) / 60,
        "front": math.asinh(between @ normals["_large"] / (NOISE_PER_M * centers[""][2] ** 2)),
        "front_large": math.asinh(-between @ normals[""] / (NOISE_PER_M * centers["_large"][2] ** 2)),
        "length": math.log(60 / unit),
        "enclosed": 60 / length,
        "enclosed_large": 60 / length_large,
        "compact": 60 / unit / math.sqrt(pixels[""] * grid_px**2),
        "pixels": math.log(pixels[""] * grid_px**2),
        "pixels_large": math.log(pixels["_large"] * grid_px**2),
        "flat": math.log(0.3 + rms[""] / NOISE_PER_M),
        "flat_large": math.log(0.3 + rms["_large"] / NOISE_PER_M),
        "flat_joint": math.log(0.3 + rms["_joint"] / NOISE_PER_M),
        "flat_loss": math.log((rms["_joint"] ** 2 + NOISE_PER_M**2) / (weighed + NOISE_PER_M**2)),
        "distance": np.linalg.norm(between) / (axes[""][2] + axes["_large"][2]),
        "extent": axes[""][2] / axes["_large"][2],
        "extent_joint": axes["_joint"][2] / axes["_large"][2],
        "height_share": heights["_joint"].std() / axes["_joint"][2],
        "height": math.asinh((heights[""].mean() - level) / noise_m),
        "height_large": math.asinh((heights["_large"].mean() - level) / noise_m),
        "height_border": math.asinh((at_border - level) / noise_m),
        "tall": math.asinh(heights[""].std() / noise_m),
        "tall_large": math.asinh(heights["_large"].std() / noise_m),
        "above": math.asinh((heights[""].mean() - heights["_large"].mean()) / noise_m),
        "above_relative": (heights[""].mean() - heights["_large"].mean())
        / (heights[""].std() + heights["_large"].std()),
        "upright_border": cosine(side, up),
        "upright_border_large": cosine(side_large, up),
    }
    for key in ("", "_large"):
        inside = (at_border - heights[key].mean()) / max(heights[key].std(), noise_m)
        expected["border_in" + key] = inside
    for key in ("", "_large", "_joint"):
        expected["thin" + key], expected["narrow" + key] = axes[key][:2] / axes[key][2]
        expected["upright" + key] = normals[key] @ up
    for name in ("border_in", "border_in_large", "above_relative"):
        expected[name] = np.clip(expected[name], -5, 5)
    assert expected.keys() == found.keys()
    # Planes are fitted with a ridge, which shows on the side of the box that is seen edge-on.
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=1e-2), name


def test_which_surface_comes_first_changes_nothing(surfaces):
    own = made_up_border(7)
    turned = np.zeros_like(own)
    border.add_border(turned, own, True)
    one = found_of(surfaces, 1, 3, own)
    other = found_of(surfaces, 3, 1, turned, lengths=(300.0, 200.0))
    assert one == other


def test_surfaces_without_points_or_a_plane_have_finite_features(surfaces):
    grid, labels, _ = surfaces
    # None of the first, and a single row of the second.
    rows = np.arange(labels.shape[0])[:, np.newaxis]
    left = (labels > 2) | ((labels == 2) & (rows == np.argwhere(labels == 2)[0, 0] + 5))
    sums = surface_statistics(np.where(left, labels, 0), 4, grid)
    assert sums[1, COUNT] == 0 < sums[2, COUNT]
    for pair in ((1, 2), (2, 3)):
        for own in (np.zeros(border.SUMS), made_up_border(1)):
            found = found_of((grid, labels, sums), *pair, own)
            assert np.isfinite(list(found.values())).all()
