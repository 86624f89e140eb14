"""Recordings and exports that earlier versions wrote: this one reads them all.

Each folder in ``kept`` is a version. A version that is released gets one; none is changed or made again.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded_scene import APART, scenes
from virtual_camera import openni2_redist, virtual_cameras

from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.check.check import FolderCheck

__all__ = ["openni2_redist", "virtual_cameras"]

VERSIONS = sorted((Path(__file__).parent / "kept").iterdir())


@pytest.fixture(params=VERSIONS, ids=lambda folder: folder.name)
def kept(request: pytest.FixtureRequest) -> Path:
    folder: Path = request.param
    return folder


def test_there_is_something_kept() -> None:
    assert VERSIONS


def test_the_recording_is_replayed_as_it_was(kept: Path) -> None:
    with open_source(kept / "scene.mcap") as source:
        frames = list(source)
        assert source.metadata["whole"] == "true"
    for expected, frame in zip(scenes(4, APART), frames, strict=True):
        assert frame.timestamp_ns == expected.timestamp_ns
        np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)
        assert frame.labels is not None
        np.testing.assert_array_equal(frame.labels, expected.labels)
        # Its color is JPEG.
        assert np.abs(frame.color.astype(int) - expected.color).mean() < 6
        np.testing.assert_allclose(frame.calibration.color_from_depth, APART.color_from_depth, atol=1e-9)


# With the same library as other tests: a process loads only one.
@pytest.mark.usefixtures("virtual_cameras")
def test_the_cameras_own_recording_is_replayed_as_it_was(kept: Path) -> None:
    with open_source(kept / "camera.oni") as source:
        frames = list(source)
        assert source.metadata["serial"] == "VC0001"
    assert len(frames) >= 3
    row, col = np.mgrid[:240, :320]
    color = np.stack([row / 2, col / 3, (row + col) / 5], axis=-1)
    for frame in frames:
        np.testing.assert_array_equal(frame.depth_mm, 1000 + 2 * row)
        assert np.abs(frame.color - color).mean() < 3


def test_the_export_is_read_and_agrees_with_its_recording(kept: Path) -> None:
    check = FolderCheck(kept / "export", str(kept / "registered.mcap"), SourceOptions())
    assert list(check.findings()) == []
    assert check.frames == 2
    assert check.recomputed > 0
    tree = json.loads((kept / "export" / "000000_tree.json").read_text())
    labels = cv2.imread(str(kept / "export" / "000000_labels.png"), cv2.IMREAD_UNCHANGED)
    assert labels is not None
    assert (labels > 0).sum() == tree["segments"][0]["size"]
