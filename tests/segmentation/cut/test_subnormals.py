"""No product meets a subnormal number, which costs some processors a hundred cycles."""

import numpy as np
import pytest

from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut import ncut
from nurbseg.segmentation.cut.affinity import affinity
from nurbseg.segmentation.extended.frame import segment_nurbseg
from nurbseg.segmentation.points.registration import register

TINY = np.finfo(np.float32).tiny


def subnormals(values) -> int:
    return int(np.count_nonzero((values != 0) & (np.abs(values) < TINY)))


def kernels_of(frames, monkeypatch) -> list[np.ndarray]:
    """The affinities of all cuts of some frames, as they are, weighted by degrees, and multiplied."""
    made = []

    def watched(*arguments):
        found = affinity(*arguments)
        made.append(found.copy())
        return found

    monkeypatch.setattr(ncut, "affinity", watched)
    for frame in frames:
        segment_nurbseg(register(frame), SegmentationConfig())
    return made


def test_real_frames_have_no_subnormal_affinities(real_data, monkeypatch):
    options = SourceOptions(intrinsics=(525.0, 525.0, 319.5, 239.5))
    with open_source(real_data("mosd_clutter"), options) as source:
        made = kernels_of([source.read() for _ in range(3)], monkeypatch)
    assert sum(K.size for K in made) > 1_000_000
    for K in made:
        weighted = K / np.sqrt(np.maximum(K.sum(axis=1, keepdims=True), np.float32(1.0)))
        assert subnormals(K) == subnormals(weighted) == 0
        # The smallest product of two of them.
        assert subnormals(weighted.min(initial=1.0) ** 2) == 0


@pytest.mark.parametrize("distance", [5.0, 9.3, 50.0, 1e4])
def test_affinities_of_far_points_are_small_and_no_smaller(distance):
    far = np.array([[distance, 0, 0]], dtype=np.float32)
    (value,) = affinity(far, np.zeros((1, 3), dtype=np.float32), 0.7).ravel()
    assert value == pytest.approx(max(np.exp(-(distance**2) / 0.98), np.exp(-40.0)), rel=1e-4)
    assert subnormals(value) == 0
