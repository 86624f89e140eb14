"""What a user names is recognized by its content."""

import errno
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded_scene import scene, scenes, write_mcap

from nurbseg.common.errors import BackendMissingError
from nurbseg.drivers import DeviceNotFoundError, RecordingFormatError, SourceOptions, open_source


def test_a_file_is_known_by_its_content_whatever_it_is_called(tmp_path: Path) -> None:
    with open_source(write_mcap(tmp_path / "a.oni", scenes(1))) as source:
        assert source.metadata["format"] == "MCAP recording"
        np.testing.assert_array_equal(source.read().depth_mm, scene(0).depth_mm)


def test_what_does_not_exist_is_not_found_and_the_schemes_are_named(tmp_path: Path) -> None:
    message = r"missing\.mcap: no such file.*openni2: or realsense: or images:"
    with pytest.raises(DeviceNotFoundError, match=message):
        open_source(tmp_path / "missing.mcap")
    with pytest.raises(DeviceNotFoundError, match="webcam:0"):
        open_source("webcam:0")


def test_a_folder_of_nothing_is_refused_with_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(RecordingFormatError, match=r"folder is empty; expected .*images: NAME_color"):
        open_source(tmp_path)
    (tmp_path / "notes.txt").write_text("nothing to see")
    with pytest.raises(
        RecordingFormatError, match=r"contains nothing that can be replayed; expected .*images: NAME_color"
    ):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"depth_scale": 0.0}, "depth_scale"),
        ({"depth_scale": float("nan")}, "depth_scale"),
        ({"association_limit_s": 0.0}, "association_limit_s"),
        ({"intrinsics": (1.0, 2.0, 3.0)}, "intrinsics: expected fx, fy, cx, cy"),
    ],
)
def test_options_out_of_bounds_are_refused(values: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        SourceOptions(**values)  # type: ignore[arg-type]


def test_replaying_a_recording_loads_no_openni2(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(1))
    program = """
import sys
from nurbseg.drivers import open_source
with open_source(sys.argv[1]) as source:
    source.read()
unwanted = ("nurbseg.drivers.openni2", "h5py", "scipy")
sys.exit(any(name.startswith(unwanted) for name in sys.modules))
"""
    assert subprocess.run([sys.executable, "-c", program, str(path)], timeout=60).returncode == 0


def test_a_missing_library_does_not_look_like_a_missing_camera() -> None:
    assert not issubclass(BackendMissingError, DeviceNotFoundError)


@pytest.mark.parametrize("method", ["exists", "iterdir"])
def test_a_place_that_may_not_be_read_is_refused(method, tmp_path, monkeypatch):
    def refuse(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, method, refuse)
    with pytest.raises(RecordingFormatError, match=r"the recording cannot be read \(Permission denied\)"):
        open_source(tmp_path)
