"""The faces of ten real frames, which surfaces are judged by."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from nurbseg.common.frame import RGBDFrame
from nurbseg.common.settings import updated
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import register

FACES = Path(__file__).parents[2] / "faces"
NAMES = sorted(path.stem for path in FACES.glob("*.png"))


# With less noise assumed, surfaces follow shallow creases within a face.
@pytest.mark.parametrize(("noise_per_m", "share"), [(2.5e-3, 0.8), (2.2e-3, 0.77)])
def test_most_faces_are_one_surface(real_data, noise_per_m, share):
    config = updated(SegmentationConfig(), extended={"inverse_depth_noise": noise_per_m})
    found = faces = surfaces = 0
    for name in NAMES:
        folder = real_data("mosd_learn" if name.startswith("learn") else "mosd_clutter")
        depth, color, truth = (
            cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            for path in (folder / f"{name}_depth.png", folder / f"{name}_color.png", FACES / f"{name}.png")
        )
        frame = RGBDFrame.from_arrays(depth, color[..., ::-1], 525.0, 525.0, 319.5, 239.5)
        table = Contingency.between(segment(register(frame), config).labels("surfaces"), truth)
        found += table.found_regions(0.6)
        surfaces, faces = surfaces + table.pixels.shape[0], faces + table.pixels.shape[1]
    assert found > share * faces
    assert surfaces < 1.25 * faces


def test_a_cylinder_is_one_surface(cloud_of, rays_of_size):
    # Upright, 10 cm wide, 90 cm away before a wall: 51 pixels wide.
    x, y, _ = np.moveaxis(rays_of_size((480, 640)), -1, 0)
    a, half_b, c = x**2 + 1.0, -0.95, 0.95**2 - 0.05**2
    inside = half_b**2 - a * c
    hit = (inside > 0) & (np.abs(y) < 0.15)
    depth = np.where(hit, (-half_b - np.sqrt(np.maximum(inside, 0.0))) / a, 1.4)
    noise_per_m = 2e-3 * np.random.default_rng(0).standard_normal(depth.shape)
    tree = segment(cloud_of(1 / (1 / depth + noise_per_m)), SegmentationConfig())
    (_, cylinder) = Contingency.between(tree.labels("surfaces"), 1 + hit.astype(int)).pixels.T
    assert cylinder.max() > 0.95 * cylinder.sum()
