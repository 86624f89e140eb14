"""Data sets with a folder for each scene."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from nurbseg.common.errors import CalibrationError, RecordingFormatError
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source

MATRIX = np.array([[300.0, 0, 31.5], [0, 300.0, 23.5], [0, 0, 1]])


def scene(folder: Path, number: int, *, calibrated: bool = True) -> Path:
    path = folder / f"scene{number}"
    path.mkdir(parents=True)
    cv2.imwrite(str(path / "color.png"), np.full((48, 64, 3), number, np.uint8))
    cv2.imwrite(str(path / "depth.png"), np.full((48, 64), 1000 + number, np.uint16))
    cv2.imwrite(str(path / "labels.png"), np.full((48, 64), number, np.uint8))
    if calibrated:
        storage = cv2.FileStorage(str(path / "calibration.xml"), cv2.FILE_STORAGE_WRITE)
        for name in ("M1", "M2"):
            storage.write(name, MATRIX)
        for name in ("D1", "D2"):
            storage.write(name, np.zeros((1, 5)))
        storage.write("R", np.eye(3))
        storage.write("T", np.array([[0.025], [0.0], [0.0]]))
        storage.release()
    return path


def test_scenes_come_in_the_order_of_their_numbers_with_their_ground_truth(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        scene(tmp_path, number)
    with open_source(str(tmp_path)) as source:
        assert source.metadata["format"] == "folder of scenes"
        frames = list(source)
    assert [frame.name for frame in frames] == ["scene1", "scene2", "scene10"]
    assert [frame.timestamp_ns for frame in frames] == pytest.approx([0, 1e9 / 30, 2e9 / 30], abs=1)
    for frame, number in zip(frames, (1, 2, 10), strict=True):
        assert frame.labels is not None
        assert (frame.labels == number).all()
        assert (frame.depth_mm == 1000 + number).all()
        assert not frame.calibration.is_registered


def test_a_scene_without_calibration_is_named(tmp_path: Path) -> None:
    scene(tmp_path, 1)
    scene(tmp_path, 2, calibrated=False)
    with pytest.raises(CalibrationError, match="scene2"):
        open_source(str(tmp_path))


def test_given_intrinsics_count_for_every_scene(tmp_path: Path) -> None:
    scene(tmp_path, 1, calibrated=False)
    options = SourceOptions(intrinsics=(300.0, 300.0, 31.5, 23.5))
    with open_source(str(tmp_path), options) as source:
        assert source.read().calibration.depth.fx == 300.0


def test_a_scene_without_images_is_named(tmp_path: Path) -> None:
    scene(tmp_path, 1)
    (tmp_path / "scene2").mkdir()
    with pytest.raises(RecordingFormatError, match="scene2"):
        open_source(str(tmp_path))
