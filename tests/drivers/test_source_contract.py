"""What every source keeps to, whatever its frames come from."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

import pytest
from database_bag import to_database
from realsense_cameras import cameras
from recorded_scene import (
    APART,
    scenes,
    write_mcap,
    write_pairs,
    write_tum,
)
from virtual_camera import VirtualCameras, openni2_redist, virtual_cameras

from nurbseg.drivers import DriverError, FrameSource, open_source
from nurbseg.drivers.registry import SCHEMES
from nurbseg.testing import SourceContract
from scene.source import SyntheticOptions, SyntheticSource

__all__ = ["cameras", "openni2_redist", "virtual_cameras"]

FRAMES = 5


@dataclass(frozen=True)
class Case:
    """How to open a source again, and how many frames it has; None for a camera."""

    open: Callable[[], FrameSource]
    frames: int | None


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Callable[[Path], Path]], Path]:
    """Each recording, written once: nothing here changes it."""
    return functools.cache(lambda write: write(tmp_path_factory.mktemp("recorded") / "recording"))


def recorded(write: Callable[[Path], Path]) -> Callable[[pytest.FixtureRequest], Case]:
    def case(request: pytest.FixtureRequest) -> Case:
        path = request.getfixturevalue("written")(write)
        return Case(lambda: open_source(str(path)), FRAMES)

    return case


def synthetic(request: pytest.FixtureRequest) -> Case:
    return Case(lambda: SyntheticSource(SyntheticOptions(frames=FRAMES, width=64, height=48)), FRAMES)


def registered_pairs(folder: Path) -> Path:
    return write_pairs(folder, scenes(FRAMES))


def images(request: pytest.FixtureRequest) -> Case:
    folder = request.getfixturevalue("written")(registered_pairs)
    patterns = urlencode({each: folder / f"*_{each}.png" for each in ("color", "depth")})
    return Case(lambda: open_source(f"images:?{patterns}"), FRAMES)


def openni2(request: pytest.FixtureRequest) -> Case:
    camera = request.getfixturevalue("virtual_cameras").add()
    return Case(lambda: open_source(f"openni2:{camera.uri}"), None)


def realsense(request: pytest.FixtureRequest) -> Case:
    request.getfixturevalue("cameras").plug()
    return Case(lambda: open_source("realsense:"), None)


CASES = {
    "mcap": recorded(lambda path: write_mcap(path, scenes(FRAMES))),
    "mcap-jpeg": recorded(lambda path: write_mcap(path, scenes(FRAMES), "jpeg95")),
    "mcap-raw-apart": recorded(lambda path: write_mcap(path, scenes(FRAMES, APART), "raw")),
    "db3": recorded(lambda path: to_database(write_mcap(path.with_suffix(".mcap"), scenes(FRAMES)), path)),
    "pairs": recorded(registered_pairs),
    "pairs-apart": recorded(lambda path: write_pairs(path, scenes(FRAMES, APART))),
    "tum": recorded(lambda path: write_tum(path, scenes(FRAMES))),
    "images": images,
    "synthetic": synthetic,
    "openni2": openni2,
    "realsense": realsense,
}


class TestContract(SourceContract):
    @pytest.fixture(autouse=True, params=CASES)
    def case(self, request: pytest.FixtureRequest) -> Case:
        self.given = CASES[request.param](request)
        self.frames = self.given.frames
        return self.given

    def open(self) -> FrameSource:
        return self.given.open()

    def test_a_recording_of_ours_is_seekable(self) -> None:
        with self.open() as source:
            assert source.seekable is (self.frames is not None)


def test_a_camera_only_goes_forward(virtual_cameras: VirtualCameras) -> None:
    camera = virtual_cameras.add()
    with open_source(f"openni2:{camera.uri}") as source:
        assert not source.seekable
        with pytest.raises(DriverError, match="cannot seek"):
            source.seek(0)


def test_every_scheme_has_a_case_here() -> None:
    assert set(SCHEMES) <= set(CASES)
