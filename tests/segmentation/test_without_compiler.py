"""Every loop does the same without the compiler, where Python checks each index: live frames, and stag15."""

from pathlib import Path

import numpy as np
from child_python import run_python
from numpy.testing import assert_allclose

from nurbseg import SegmentationConfig, Segmenter
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.common.settings import updated

HEIGHT, WIDTH = 24, 32
CAMERA = WIDTH, HEIGHT, 28.0, 28.0, 15.5, 11.5
ASIDE = np.eye(4) - 0.02 * np.eye(4, k=3)
CALIBRATION = Calibration(
    Intrinsics(*CAMERA), Intrinsics(*CAMERA, np.array([0.05, -0.02, 0.0, 0.0, 0.0])), ASIDE
)


def frame(index: int) -> RGBDFrame:
    """Two walls that meet, a floor, a slanted box that moves, and another thing."""
    row, column = np.indices((HEIGHT, WIDTH))
    inverse_depth = np.maximum(0.5 + 0.012 * abs(column - 14), 0.03 * (row - 4.0))
    box = (row > 9 + index % 2) & (row < 19) & (column > 4 + index) & (column < 14 + index)
    inverse_depth[box] = 0.72 + 0.02 * (column[box] - 4 - index)
    inverse_depth[15:22, 25:] = 0.66
    depth_mm = 1000.0 / inverse_depth + np.random.default_rng(index).normal(0.0, 2.0, row.shape)
    depth_mm[:, :1] = depth_mm[20:22, 20:22] = 0.0
    color = np.where(column[..., None] > 14, (60, 60, 140), (90, 120, 60))
    color[box] = 220, 40, 30
    images = depth_mm.astype(np.uint16), color.astype(np.uint8)
    return RGBDFrame(index, index * 33_000_000, *images, CALIBRATION)


def values() -> list[float]:
    """Return labels, identities, fits and evidence of some frames."""
    found: list[float] = []
    live = Segmenter(updated(SegmentationConfig(decimation=1), extended={"piece_pixels_min": 2000}))
    results = [live.process(frame(index)) for index in (0, 1, 2, 3, 5)]
    for metric in ("mse", "vmxc"):
        config = SegmentationConfig(method="stag15", metric=metric, samples=20, decimation=2)
        results.append(Segmenter(config).process(frame(0)))
    for result in results:
        for level in ("surfaces", "objects"):
            found += result.labels(level).ravel().tolist()
        found += [*result.surface_identities.of_label.values(), len(result.events)]
        for leaf in result.tree.leaves():
            found += [leaf.fit.values["mse"], leaf.fit.floor]
        for contact in result.tree.contacts:
            found += [contact.log_odds, contact.samples, contact.merged]
    return found


_CHILD = """
import sys
sys.path[:0] = sys.argv[1:]
from nurbseg.common.compiled import config
from test_without_compiler import values
assert config.DISABLE_JIT
print(*map(float, values()))
"""


def test_the_loops_do_the_same_without_the_compiler():
    folders = str(Path(__file__).parent), str(Path(__file__).parents[1] / "fakes")
    plain = run_python(_CHILD, *folders, environment={"NUMBA_DISABLE_JIT": "1"})
    assert_allclose(np.array(plain.stdout.split(), dtype=float), values(), rtol=1e-6, atol=1e-9)
