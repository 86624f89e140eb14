"""NYU Depth v2 frames, from files of the set's form and from real ones."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import scipy.io

from nurbseg.common.errors import (
    DeviceNotFoundError,
    EndOfRecordingError,
    RecordingFormatError,
)
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source


def labelled_set(path: Path, frames: int = 3, **left_out: None) -> Path:
    rng = np.random.default_rng(0)
    with h5py.File(path, "w", userblock_size=512) as file:
        file["images"] = rng.integers(0, 256, (frames, 3, 64, 48), dtype=np.uint8)
        file["depths"] = rng.uniform(0.5, 4.0, (frames, 64, 48)).astype(np.float32)
        labels = np.zeros((frames, 64, 48), np.uint16)
        labels[:, :32] = 5
        labels[:, 32:60] = 7
        instances = np.zeros((frames, 64, 48), np.uint8)
        instances[:, :32, :24] = 1
        instances[:, :32, 24:] = 2
        instances[:, 32:60] = 1
        # Of no class, and so of no region.
        instances[:, 60:] = 3
        file["labels"], file["instances"] = labels, instances
        for name in left_out:
            del file[name]
    return path


def test_the_labelled_set_is_read_upright_with_a_region_for_each_instance(tmp_path: Path) -> None:
    path = labelled_set(tmp_path / "nyu_depth_v2_labeled.mat")
    with open_source(f"nyu:{path}") as source:
        frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2]
    with h5py.File(path) as file:
        np.testing.assert_array_equal(frames[1].color[:, :, 2], file["images"][1, 2].T)
        np.testing.assert_allclose(frames[1].depth_mm, file["depths"][1].T * 1000, atol=0.5001)
    labels = frames[0].labels
    assert labels is not None
    assert set(np.unique(labels)) == {0, 1, 2, 3}
    assert labels[0, 0] != labels[47, 0]
    assert (labels[:, 60:] == 0).all()


def test_a_given_calibration_takes_the_place_of_the_sets_own(tmp_path: Path) -> None:
    path = labelled_set(tmp_path / "set.mat", frames=1)
    given = Calibration.registered(Intrinsics(width=64, height=48, fx=70.0, fy=71.0, cx=31.5, cy=23.5))
    with open_source(f"nyu:{path}", SourceOptions(calibration=given)) as source:
        assert source.calibration.depth.fy == source.read().calibration.color.fy == 71.0


def test_skipping_the_labelled_set_reads_nothing_in_between(tmp_path: Path) -> None:
    with open_source(f"nyu:{labelled_set(tmp_path / 'set.mat', frames=5)}") as source:
        assert source.skip(3) == 3
        assert source.read().index == 3
        assert source.skip(9) == 1
        with pytest.raises(EndOfRecordingError):
            source.read()


def test_a_labelled_set_without_its_depths_is_refused_by_name(tmp_path: Path) -> None:
    path = labelled_set(tmp_path / "set.mat", depths=None)
    with pytest.raises(RecordingFormatError, match=r"set\.mat: not the labeled set of NYU Depth v2 .*depths"):
        open_source(f"nyu:{path}")


def test_single_frames_split_a_class_into_its_connected_parts(tmp_path: Path) -> None:
    depth_m = np.full((24, 32), 1.5)
    depth_m[0, 0] = np.nan
    record = {"rgb": np.full((24, 32, 3), 0.5), "realDepth": depth_m}
    scipy.io.savemat(tmp_path / "nyu_v2_12.mat", {"data": record})
    classes = np.zeros((48, 64), np.uint8)
    classes[:10, :10] = 4
    classes[30:, 40:] = 4
    classes[:10, 40:] = 9
    cv2.imwrite(str(tmp_path / "new_nyu_class13_0012.png"), classes)
    with open_source(f"nyu:{tmp_path}") as source:
        (frame,) = list(source)
    assert frame.labels is not None
    assert set(np.unique(frame.labels)) == {0, 1, 2, 3}
    assert frame.depth_mm[0, 0] == 0
    assert frame.depth_mm[5, 5] == 1500


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_single_frames_may_have_color_of_0_to_255(tmp_path: Path, dtype: type[np.generic]) -> None:
    color = np.arange(24 * 32 * 3).reshape(24, 32, 3) % 256
    record = {"rgb": color.astype(dtype), "realDepth": np.full((24, 32), 1.5)}
    scipy.io.savemat(tmp_path / "nyu_v2_1.mat", {"data": record})
    with open_source(f"nyu:{tmp_path}") as source:
        np.testing.assert_array_equal(source.read().color, color)


def test_colors_of_0_to_1_may_overshoot_by_resampling(tmp_path: Path) -> None:
    color = np.linspace(-0.03, 1.025, 24 * 32 * 3).reshape(24, 32, 3)
    scipy.io.savemat(tmp_path / "nyu_v2_1.mat", {"data": {"rgb": color, "realDepth": np.full((24, 32), 1.5)}})
    with open_source(f"nyu:{tmp_path}") as source:
        found = source.read().color
    assert (found.min(), found.max()) == (0, 255)
    inside = (color >= 0) & (color <= 1)
    assert np.abs(found[inside] - 255 * color[inside]).max() <= 0.5


@pytest.mark.parametrize("name", ["labels", "instances", "images"])
def test_a_labelled_set_of_disagreeing_shapes_is_refused_by_name(tmp_path: Path, name: str) -> None:
    path = labelled_set(tmp_path / "set.mat")
    with h5py.File(path, "a") as file:
        smaller = file[name][:, :, :40]
        del file[name]
        file[name] = smaller
    with pytest.raises(RecordingFormatError, match=r"set\.mat"):
        open_source(f"nyu:{path}")


def test_a_single_frame_that_is_cut_off_is_passed_over(tmp_path: Path) -> None:
    for number in (1, 2):
        record = {"rgb": np.full((24, 32, 3), 0.5), "realDepth": np.full((24, 32), 1.5)}
        scipy.io.savemat(tmp_path / f"nyu_v2_{number}.mat", {"data": record}, do_compression=True)
    first = tmp_path / "nyu_v2_1.mat"
    first.write_bytes(first.read_bytes()[: first.stat().st_size // 2])
    with open_source(f"nyu:{tmp_path}") as source:
        assert [frame.name for frame in source] == ["nyu_v2_2"]
        (text,) = source.status.damaged_frames
        assert "nyu_v2_1.mat" in text


@pytest.mark.parametrize("name", ["nyu_v2_1.mat", "set.mat"])
def test_a_file_of_something_else_is_refused(tmp_path: Path, name: str) -> None:
    if name == "set.mat":
        (tmp_path / name).write_bytes(b"hello")
    else:
        scipy.io.savemat(tmp_path / name, {"other": np.zeros(3)})
    with pytest.raises(RecordingFormatError, match=rf"{name}"):
        open_source(f"nyu:{tmp_path / name}")
    with pytest.raises(DeviceNotFoundError, match="no such file"):
        open_source(f"nyu:{tmp_path / 'none'}")


def test_real_frames_are_scored_by_the_command(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    words = ["run", f"nyu:{real_data('nyuv2_small')}", "--frames", "1", "--time-frames", "0"]
    command = [str(Path(sys.executable).with_name("nurbseg-eval")), *words, "--out", str(tmp_path / "o")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    assert "1 frames" in done.stdout + done.stderr
