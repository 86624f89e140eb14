"""What every source keeps to, whatever its frames come from."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from database_bag import to_database
from realsense_cameras import cameras
from recorded_scene import (
    APART,
    back_projected,
    scenes,
    write_mcap,
    write_pairs,
    write_pcd,
    write_tum,
)
from virtual_camera import VirtualCameras, openni2_redist, virtual_cameras

from nurbseg.drivers import DriverError, EndOfRecordingError, FrameSource, RGBDFrame, open_source
from nurbseg.drivers.registry import SCHEMES
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


def pcd_folder(folder: Path) -> Path:
    for frame in scenes(FRAMES):
        write_pcd(folder / f"cloud{frame.index}.pcd", back_projected(frame), frame.color, "binary")
    return folder


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
    "pcd": recorded(pcd_folder),
    "images": images,
    "synthetic": synthetic,
    "openni2": openni2,
    "realsense": realsense,
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param](request)


@pytest.fixture
def recording(case: Case) -> Case:
    if case.frames is None:
        pytest.skip("a camera has no end")
    return case


def some(source: FrameSource) -> Iterator[RGBDFrame]:
    return (source.read(timeout_s=5.0) for _ in range(FRAMES))


def same(one: RGBDFrame, other: RGBDFrame) -> bool:
    labels = (one.labels is None) == (other.labels is None) and (
        one.labels is None or np.array_equal(one.labels, other.labels)
    )
    pixels = np.array_equal(one.depth_mm, other.depth_mm) and np.array_equal(one.color, other.color)
    return pixels and labels and (one.index, one.timestamp_ns) == (other.index, other.timestamp_ns)


def test_frames_are_numbered_and_their_time_continues(case: Case) -> None:
    with case.open() as source:
        frames = list(some(source))
        missed = source.missed
    numbers = [frame.index for frame in frames]
    assert numbers == sorted(set(numbers))
    # A loop over a camera that is late leaves frames out, and counts them.
    assert numbers[-1] - numbers[0] + 1 == FRAMES + missed
    assert missed == 0 or case.frames is None
    stamps = [frame.timestamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))


def test_images_have_their_cameras_sizes_and_show_something(case: Case) -> None:
    with case.open() as source:
        for frame in some(source):
            assert frame.depth_mm.shape == (source.calibration.depth.height, source.calibration.depth.width)
            assert frame.color.shape[:2] == (source.calibration.color.height, source.calibration.color.width)
            assert frame.depth_mm.any()
            assert frame.color.any()


def test_images_cannot_be_changed(case: Case) -> None:
    with case.open() as source:
        frame = source.read(timeout_s=5.0)
    for image in (frame.depth_mm, frame.color):
        with pytest.raises(ValueError, match="read-only"):
            image[0] = 1


def test_a_frame_stays_as_it_is_when_later_ones_are_read_and_the_source_is_closed(case: Case) -> None:
    with case.open() as source:
        first = source.read(timeout_s=5.0)
        depth_mm, color = first.depth_mm.copy(), first.color.copy()
        for _ in range(FRAMES - 1):
            source.read(timeout_s=5.0)
    np.testing.assert_array_equal(first.depth_mm, depth_mm)
    np.testing.assert_array_equal(first.color, color)


def test_closing_twice_is_fine_and_reading_afterwards_is_an_error(case: Case) -> None:
    source = case.open()
    source.read(timeout_s=5.0)
    assert source.is_open()
    source.close()
    source.close()
    assert not source.is_open()
    with pytest.raises(DriverError, match="closed"):
        source.read()


def test_a_source_is_closed_when_its_block_is_left_by_an_error(case: Case) -> None:
    with pytest.raises(ZeroDivisionError), case.open() as source:
        raise ZeroDivisionError
    with pytest.raises(DriverError, match="closed"):
        source.read()


def test_metadata_is_text_and_says_what_the_source_is(case: Case) -> None:
    with case.open() as source:
        assert source.metadata
        assert all(isinstance(each, str) for pair in source.metadata.items() for each in pair)
        assert source.live is (case.frames is None)


def test_a_recording_ends_and_stays_at_its_end(recording: Case) -> None:
    with recording.open() as source:
        assert len(list(source)) == recording.frames
        for _ in range(2):
            with pytest.raises(EndOfRecordingError):
                source.read()


def test_a_recording_is_the_same_each_time(recording: Case) -> None:
    with recording.open() as one, recording.open() as other:
        assert all(same(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("passed", [0, 1, 3, FRAMES])
def test_skipping_leads_to_the_frame_that_reading_leads_to(recording: Case, passed: int) -> None:
    with recording.open() as source:
        frames = list(source)
    with recording.open() as source:
        assert source.skip(passed) == passed
        rest = list(source)
    assert len(rest) == len(frames) - passed
    assert all(same(a, b) for a, b in zip(rest, frames[passed:], strict=True))


def test_skipping_past_the_end_says_how_many_frames_there_were(recording: Case) -> None:
    with recording.open() as source:
        source.read()
        assert source.skip(100) == recording.frames - 1
        assert source.skip(1) == 0
        with pytest.raises(EndOfRecordingError):
            source.read()


@pytest.mark.parametrize("read", [0, 2, FRAMES])
@pytest.mark.parametrize("index", [0, 1, 2, 4])
def test_a_recording_goes_to_any_frame_from_anywhere(recording: Case, index: int, read: int) -> None:
    with recording.open() as source:
        frames = list(source)
    with recording.open() as source:
        assert source.seekable
        for _ in range(read):
            source.read()
        source.seek(index)
        rest = list(source)
        source.seek(index)
        assert same(source.read(), frames[index])
    assert len(rest) == FRAMES - index
    assert all(same(a, b) for a, b in zip(rest, frames[index:], strict=True))


def test_beyond_its_ends_a_recording_goes_to_the_first_and_the_last_frame(recording: Case) -> None:
    with recording.open() as source:
        source.seek(100)
        assert [frame.index for frame in source] == [FRAMES - 1]
        source.seek(-3)
        assert source.read().index == 0
    with pytest.raises(DriverError, match="closed"):
        source.seek(0)


def test_a_camera_only_goes_forward(virtual_cameras: VirtualCameras) -> None:
    camera = virtual_cameras.add()
    with open_source(f"openni2:{camera.uri}") as source:
        assert not source.seekable
        with pytest.raises(DriverError, match="cannot seek"):
            source.seek(0)


def test_a_recording_has_one_reader_and_no_newest_frame(recording: Case) -> None:
    with recording.open() as source:
        assert source.reader() is source
        with pytest.raises(DriverError, match="only a camera has a newest frame"):
            source.latest(1000.0)


def test_the_newest_frame_of_a_camera_is_there_after_one_was_read(virtual_cameras: VirtualCameras) -> None:
    camera = virtual_cameras.add()
    with open_source(f"openni2:{camera.uri}") as source:
        read = source.read(timeout_s=5.0)
        newest = source.latest(60_000.0)
        assert newest.index >= read.index
        assert same(newest, read) or newest.timestamp_ns > read.timestamp_ns


def test_every_scheme_has_a_case_here() -> None:
    assert set(SCHEMES) <= set(CASES)
