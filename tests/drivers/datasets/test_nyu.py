"""NYU Depth v2 frames, from files of the set's form and from real ones."""

import resource
import signal
import zlib
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
from own_children import own_children

from nurbseg.common.depth import millimeters
from nurbseg.common.errors import EndOfRecordingError, FrameFormatError, RecordingFormatError
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
        file["labels"], file["instances"] = labels, instances
        for name in left_out:
            del file[name]
    return path


def test_the_labelled_set_is_read_upright_with_a_region_for_each_instance(tmp_path: Path) -> None:
    path = labelled_set(tmp_path / "nyu_depth_v2_labeled.mat")
    with open_source(path) as source:
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
    with open_source(path, SourceOptions(calibration=given)) as source:
        assert source.calibration.depth.fy == source.read().calibration.color.fy == 71.0


def test_skipping_the_labelled_set_reads_nothing_in_between(tmp_path: Path) -> None:
    with open_source(labelled_set(tmp_path / "set.mat", frames=5)) as source:
        assert source.skip(3) == 3
        assert source.read().index == 3
        assert source.skip(9) == 1
        with pytest.raises(EndOfRecordingError):
            source.read()


def test_a_labelled_set_without_its_depths_is_refused_by_name(tmp_path: Path) -> None:
    path = labelled_set(tmp_path / "set.mat", depths=None)
    with pytest.raises(RecordingFormatError, match=r"'depths' is missing, as in .* as 16-bit PNG or \.npy"):
        open_source(path)


@pytest.mark.parametrize("shape", [(64, 48), (0, 64, 48), (3, 64, 0)])
def test_a_labelled_set_without_frames_is_refused_by_name(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = labelled_set(tmp_path / "set.mat")
    with h5py.File(path, "r+") as file:
        del file["depths"]
        file["depths"] = np.ones(shape, np.float32)
    named = r"set\.mat: depths: expected \(frames, columns, rows\)"
    with pytest.raises(RecordingFormatError, match=named) as caught:
        open_source(path)
    # It is not one frame of many that is damaged.
    assert not isinstance(caught.value, FrameFormatError)


def test_single_frames_split_a_class_into_its_connected_parts(tmp_path: Path) -> None:
    depth_m = np.full((24, 32), 1.5)
    depth_m[0, 0] = np.nan
    record = {"rgb": np.full((24, 32, 3), 0.5), "realDepth": depth_m}
    scipy.io.savemat(tmp_path / "nyu_v2_12.mat", {"data": record})
    classes = np.zeros((48, 64), np.uint8)
    classes[:10, :10] = 4
    classes[30:, 40:] = 4
    cv2.imwrite(str(tmp_path / "new_nyu_class13_0012.png"), classes)
    with open_source(tmp_path) as source:
        (frame,) = list(source)
    assert frame.labels is not None
    assert set(np.unique(frame.labels)) == {0, 1, 2}
    assert frame.depth_mm[0, 0] == 0
    assert frame.depth_mm[5, 5] == 1500


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_single_frames_may_have_color_of_0_to_255(tmp_path: Path, dtype: type[np.generic]) -> None:
    color = np.arange(24 * 32 * 3).reshape(24, 32, 3) % 256
    record = {"rgb": color.astype(dtype), "realDepth": np.full((24, 32), 1.5)}
    scipy.io.savemat(tmp_path / "nyu_v2_1.mat", {"data": record})
    with open_source(tmp_path) as source:
        np.testing.assert_array_equal(source.read().color, color)


def test_colors_of_0_to_1_may_overshoot_by_resampling(tmp_path: Path) -> None:
    color = np.linspace(-0.03, 1.025, 24 * 32 * 3).reshape(24, 32, 3)
    scipy.io.savemat(tmp_path / "nyu_v2_1.mat", {"data": {"rgb": color, "realDepth": np.full((24, 32), 1.5)}})
    with open_source(tmp_path) as source:
        found = source.read().color
    assert (found.min(), found.max()) == (0, 255)
    inside = (color >= 0) & (color <= 1)
    assert np.abs(found[inside] - 255 * color[inside]).max() <= 0.5


def test_a_folder_of_the_labelled_set_alone_is_the_set(tmp_path: Path) -> None:
    labelled_set(tmp_path / "nyu_depth_v2_labeled.mat")
    with open_source(tmp_path) as source:
        assert len(list(source)) == 3


def test_a_class_that_is_none_of_the_13_costs_the_labels(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    record = {"rgb": np.full((24, 32, 3), 0.5), "realDepth": np.full((24, 32), 1.5)}
    scipy.io.savemat(tmp_path / "nyu_v2_12.mat", {"data": record})
    classes = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
    cv2.imwrite(str(tmp_path / "new_nyu_class13_0012.png"), classes)
    with open_source(tmp_path) as source:
        frame = source.read()
    assert frame.labels is None
    assert (frame.depth_mm == 1500).all()
    assert "class13_0012.png: expected classes from 0 to 13, got 767" in caplog.text


@pytest.mark.parametrize("name", ["labels", "instances", "images"])
def test_a_labelled_set_of_disagreeing_shapes_is_refused_by_name(tmp_path: Path, name: str) -> None:
    path = labelled_set(tmp_path / "set.mat")
    with h5py.File(path, "a") as file:
        smaller = file[name][:, :, :40]
        del file[name]
        file[name] = smaller
    with pytest.raises(RecordingFormatError, match=f"{name}: expected"):
        open_source(path)


def test_a_single_frame_that_is_cut_off_is_passed_over(tmp_path: Path) -> None:
    for number in (1, 2):
        record = {"rgb": np.full((24, 32, 3), 0.5), "realDepth": np.full((24, 32), 1.5)}
        scipy.io.savemat(tmp_path / f"nyu_v2_{number}.mat", {"data": record}, do_compression=True)
    first = tmp_path / "nyu_v2_1.mat"
    first.write_bytes(first.read_bytes()[: first.stat().st_size // 2])
    with open_source(tmp_path) as source:
        with pytest.raises(FrameFormatError, match=r"nyu_v2_1\.mat"):
            source.read()
        assert source.read().name == "nyu_v2_2"


def test_a_matlab_file_of_something_else_is_refused(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "nyu_v2_1.mat", {"other": np.zeros(3)})
    with pytest.raises(RecordingFormatError, match=r"nyu_v2_1\.mat.*realDepth"):
        open_source(tmp_path / "nyu_v2_1.mat")


def test_what_is_no_distance_becomes_no_depth() -> None:
    depth_m = np.array([[np.nan, np.inf, -1.0, 0.0, 0.0004, 70.0, 1.2344]])
    np.testing.assert_array_equal(millimeters(depth_m, units_per_meter=1.0), [[0, 0, 0, 0, 0, 0, 1234]])


def hostile_set(path: Path, kind: str) -> Path:
    """A labeled set of some kilobytes whose images would take gigabytes, or are somewhere else."""
    labelled_set(path, frames=1)
    with h5py.File(path, "a") as file:
        del file["images"], file["depths"]
        images = file.create_dataset("images", (1, 3, 64, 48), "u1")
        if kind == "shape":
            file.create_dataset("depths", (1, 60_000, 60_000), "f4", chunks=(1, 100, 100))
        elif kind == "chunk":
            depths = file.create_dataset(
                "depths", (1, 64, 48), "f4", maxshape=(None,) * 3, chunks=(1, 16000, 16000)
            )
            assert depths.chunks[1] == 16000
        elif kind == "strings":
            file.create_dataset("depths", (1, 64, 48), h5py.string_dtype())
        elif kind == "external link":
            file["depths"] = h5py.ExternalLink("other.mat", "/depths")
        elif kind == "soft link":
            file["depths"] = h5py.SoftLink("/depths")
        elif kind == "external storage":
            file.create_dataset("depths", (1, 64, 48), "f4", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])
        elif kind == "virtual":
            layout = h5py.VirtualLayout(images.shape[:1] + images.shape[2:], "f4")
            layout[:] = h5py.VirtualSource("other.mat", "depths", (1, 64, 48))
            file.create_virtual_dataset("depths", layout)
        else:
            file.create_group("depths")
    return path


@pytest.mark.parametrize(
    "kind",
    ["shape", "chunk", "strings", "external link", "soft link", "external storage", "virtual", "group"],
)
def test_a_set_that_is_too_large_or_elsewhere_is_refused_by_name(tmp_path: Path, kind: str) -> None:
    path = hostile_set(tmp_path / "set.mat", kind)
    assert path.stat().st_size < 100_000
    with pytest.raises(RecordingFormatError, match=r"set\.mat: depths: expected"):
        open_source(path)


def test_a_set_that_becomes_gigabytes_costs_its_frame(tmp_path: Path) -> None:
    path = labelled_set(tmp_path / "set.mat", frames=2)
    with h5py.File(path, "a") as file:
        depths = file["depths"][:]
        del file["depths"]
        packed = file.create_dataset("depths", data=depths, chunks=(1, 64, 48), compression=1)
        bomb = zlib.compressobj(9)
        head = bomb.compress(b"") + bomb.flush(zlib.Z_FULL_FLUSH)
        # A whole block, which may be repeated; its checksum comes after gigabytes.
        block = bomb.compress(bytes(1 << 20)) + bomb.flush(zlib.Z_FULL_FLUSH)
        content = head + block * (4 << 10) + bomb.flush()
        packed.id.write_direct_chunk((0, 0, 0), content)
    with open_source(path) as source:
        with pytest.raises(FrameFormatError, match=r"set\.mat: cannot be read"):
            source.read()
        assert source.read().index == 1
    usage = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    assert usage < 4 << 20


def test_a_file_that_ends_the_process_costs_its_frame(tmp_path: Path) -> None:
    with open_source(labelled_set(tmp_path / "set.mat")) as source:
        (child,) = own_children()
        child.send_signal(signal.SIGSEGV)
        with pytest.raises(FrameFormatError, match=r"set\.mat: .* ended by signal 11"):
            source.read()
        assert source.read().index == 1
    assert own_children() == []


def changed(content: bytes, rng: np.random.Generator) -> bytes:
    array = np.frombuffer(content, np.uint8).copy()
    # Most of the structure is at the beginning.
    places = rng.integers(128, min(700, len(content)), 5)
    array[places] = rng.integers(0, 256, 5)
    return array.tobytes()


def test_bytes_changed_in_matlab_files_cost_frames_at_most(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    record = {"rgb": np.full((24, 32, 3), 0.5), "realDepth": np.full((24, 32), 1.5)}
    scipy.io.savemat(tmp_path / "nyu_v2_0.mat", {"data": record})
    content = (tmp_path / "nyu_v2_0.mat").read_bytes()
    for number in range(1, 60):
        (tmp_path / f"nyu_v2_{number}.mat").write_bytes(changed(content, rng))
    read = refused = 0
    with open_source(tmp_path) as source:
        for _ in range(60):
            try:
                source.read()
                read += 1
            except FrameFormatError as err:
                assert f"nyu_v2_{read + refused}.mat" in str(err)
                refused += 1
    assert read > 0
    assert refused > 10


def test_bytes_changed_in_a_labelled_set_lead_to_typed_errors_only(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    content = labelled_set(tmp_path / "set.mat", frames=1).read_bytes()
    assert content[512:520] == b"\x89HDF\r\n\x1a\n"
    path = tmp_path / "changed.mat"
    refused = 0
    for _ in range(8):
        path.write_bytes(changed(content, rng))
        try:
            with open_source(path) as source:
                source.read()
        except RecordingFormatError as err:
            assert "changed.mat: " in str(err)
            refused += 1
    assert refused > 0
