"""Each form of recording: its frames, the contract of a source, damage, and memory."""

from __future__ import annotations

import functools
import logging
import shutil
import struct
from collections.abc import Callable, Container
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from all_frames import frames_and_errors
from bounded_child import read_bounded
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from realsense_cameras import cameras
from recorded_forms import FORMS, FRAMES, Form, by_topic, database, frames_of, robot, ros1
from recorded_scene import INTERVAL_NS
from virtual_camera import VirtualCameras, openni2_redist, virtual_cameras

from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers import DriverError, FrameSource, RecordingFormatError, RGBDFrame, open_source
from nurbseg.drivers.opening import SCHEMES
from nurbseg.testing import SourceContract
from scene.source import SyntheticOptions, SyntheticSource

__all__ = ["cameras", "openni2_redist", "virtual_cameras"]

Written = Callable[[str], tuple[Path, list[RGBDFrame]]]
FILES = [name for name in FORMS if name.startswith(("ours", "mcap", "rosbag2", "db3", "bag"))]
FILES.remove("db3-split")


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """Each recording, written once: nothing here changes it."""

    @functools.cache
    def write(name: str) -> tuple[Path, list[RGBDFrame]]:
        frames = frames_of(FORMS[name])
        return FORMS[name].write(tmp_path_factory.mktemp("recorded"), frames), frames

    return write


def file_of(path: Path) -> Path:
    """Return the only file of a bag."""
    return path if path.is_file() else next(each for each in path.iterdir() if each.suffix != ".yaml")


def assert_same(form: Form, one: RGBDFrame, other: RGBDFrame, *, labels: bool = True) -> None:
    expected_ns = {"counted": one.index * INTERVAL_NS}.get(form.stamps, one.timestamp_ns)
    assert abs(expected_ns - other.timestamp_ns) < {"microseconds": 1000}.get(form.stamps, 1)
    np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
    assert np.abs(one.color.astype(int) - other.color).mean() < (1e-9 if form.exact_color else 6)
    if labels and form.labels:
        np.testing.assert_array_equal(one.labels, other.labels)
    else:
        assert other.labels is None or np.array_equal(one.labels, other.labels)


@pytest.mark.parametrize("name", FORMS)
def test_the_frames_are_those_that_were_written(written: Written, name: str, caplog) -> None:
    form, (path, frames) = FORMS[name], written(name)
    with caplog.at_level(logging.WARNING), open_source(path) as source:
        again = list(source)
        found = source.calibration
        assert source.metadata["depth_unit"] == form.unit
        assert source.metadata["dropped"] == "0"
        assert (len(source), source.metadata["frames"]) == (FRAMES, str(FRAMES))
    for index, (one, other) in enumerate(zip(frames, again, strict=True)):
        assert other.index == index
        assert_same(form, one, other)
    np.testing.assert_allclose(found.color_from_depth, form.calibration.color_from_depth, atol=1e-9)
    assert found.is_registered == form.calibration.is_registered
    for camera in ("depth", "color"):
        read, given = getattr(found, camera), getattr(form.calibration, camera)
        np.testing.assert_allclose(read.matrix, given.matrix, rtol=1e-12)
        np.testing.assert_allclose(read.distortion, given.distortion, rtol=1e-12)
    assert name == "scenes" or len({id(frame.calibration) for frame in again}) == 1
    if not form.said:
        assert caplog.messages == []
    assert form.said in caplog.text


@dataclass(frozen=True)
class Opened:
    """How to open a source again, and how many frames it has; None for a camera."""

    open: Callable[[], FrameSource]
    frames: int | None


def synthetic(request: pytest.FixtureRequest) -> Opened:
    return Opened(lambda: SyntheticSource(SyntheticOptions(frames=5, width=64, height=48)), 5)


def openni2(request: pytest.FixtureRequest) -> Opened:
    camera = request.getfixturevalue("virtual_cameras").add()
    return Opened(lambda: open_source(f"openni2:{camera.uri}"), None)


def realsense(request: pytest.FixtureRequest) -> Opened:
    request.getfixturevalue("cameras").plug()
    return Opened(lambda: open_source("realsense:"), None)


OTHERS = {"synthetic": synthetic, "openni2": openni2, "realsense": realsense}


class TestContract(SourceContract):
    @pytest.fixture(autouse=True, params=[*FORMS, *OTHERS])
    def opened(self, request: pytest.FixtureRequest) -> Opened:
        if request.param in FORMS:
            path, _ = request.getfixturevalue("written")(request.param)
            self.given = Opened(lambda: open_source(path), FRAMES)
        else:
            self.given = OTHERS[request.param](request)
        self.frames = self.given.frames
        return self.given

    def open(self) -> FrameSource:
        return self.given.open()

    def test_a_recording_of_ours_is_seekable(self) -> None:
        with self.open() as source:
            assert source.seekable is (self.frames is not None)


def test_a_camera_only_goes_forward(virtual_cameras: VirtualCameras) -> None:
    camera = virtual_cameras.add()
    with open_source(f"openni2:{camera.uri}") as source, pytest.raises(DriverError, match="cannot seek"):
        source.seek(0)


def test_every_scheme_is_held_to_the_contract() -> None:
    assert set(SCHEMES) <= {"images", *OTHERS}


def changed(path: Path, folder: Path, change: Callable[[bytes], bytes]) -> tuple[Path, Path]:
    """Copy a recording and change its file; return what to open and the file."""
    copy = folder / path.name
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(path, copy) if path.is_dir() else shutil.copy(path, copy)
    file = file_of(copy)
    file.write_bytes(change(file.read_bytes()))
    return copy, file


def replayed(path: Path, caplog: pytest.LogCaptureFixture) -> tuple[list[RGBDFrame], list[str]]:
    """Return the frames that can be read, and what is said of the others."""
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        try:
            frames, errors = frames_and_errors(path)
        except DriverError as err:
            return [], [str(err)]
    return frames, errors + caplog.messages


def whole_frames(content: bytes) -> int:
    """Count the frames whose images are in whole chunks of part of an MCAP file, by the mcap library."""
    channels: dict[int, str] = {}
    images: dict[str, set[int]] = {"depth": set(), "color": set()}
    try:
        for record in StreamReader(BytesIO(content)).records:
            if isinstance(record, Channel):
                channels[record.id] = record.topic
            elif isinstance(record, Message):
                topic = channels[record.channel_id]
                if "image" in topic and (kind := topic.split("/")[2]) in images:
                    images[kind].add(int.from_bytes(record.data[4:12], "little") or record.log_time)
    except (McapError, struct.error):
        pass
    return len(images["depth"] & images["color"])


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_off_anywhere_is_replayed_to_its_last_whole_chunk_or_refused(
    written: Written, name: str, tmp_path: Path, caplog
) -> None:
    form, (path, frames) = FORMS[name], written(name)
    stamps = {frame.timestamp_ns: frame for frame in frames}
    size = file_of(path).stat().st_size
    counts = []
    for place in [*np.linspace(form.cut_from * size + 9, size - 9, 9).astype(int), size - 1]:
        copy, file = changed(path, tmp_path, lambda content, place=place: content[:place])
        read, said = replayed(copy, caplog)
        if read:
            assert any("cut off" in text or "cannot be read further" in text for text in said), place
        else:
            assert str(copy) in said[0], place
        for frame in read:
            assert_same(form, stamps[frame.timestamp_ns], frame, labels=False)
        if file.suffix == ".mcap" and "packed" not in name:
            assert whole_frames(file.read_bytes()) <= len(read)
        counts.append(len(read))
    assert counts == sorted(counts)
    assert counts[-1] == FRAMES or file.suffix != ".mcap"


def places(content: bytes, suffix: str, kinds: Container[int] = range(256)) -> list[int]:
    """Return the middle of each record of these kinds of an MCAP file, or places all over another file."""
    if suffix != ".mcap":
        return np.linspace(16, len(content) - 1, 40).astype(int).tolist()
    found, place = [], 8
    while content[place] != Opcode.FOOTER:
        length = int.from_bytes(content[place + 1 : place + 9], "little")
        if content[place] in kinds:
            found.append(place + 9 + length // 2)
        place += 9 + length
    return found


@pytest.mark.parametrize("name", FILES)
def test_a_changed_byte_in_any_record_costs_its_chunk_at_most(written, name, tmp_path, caplog):
    form, (path, frames) = FORMS[name], written(name)
    content = file_of(path).read_bytes()
    stamps = {frame.timestamp_ns: frame for frame in frames}
    # The first one holds the cameras.
    chunks = places(content, ".mcap", [Opcode.CHUNK])[1:] if form.is_checked and not form.cut_from else []
    for place in places(content, file_of(path).suffix):
        copy, _ = changed(
            path, tmp_path, lambda old, at=place: old[:at] + bytes([old[at] ^ 0xFF]) + old[at + 1 :]
        )
        read, said = replayed(copy, caplog)
        assert len(read) == FRAMES or said, place
        assert len(read) >= FRAMES - 4 or place not in chunks, place
        if form.is_checked:
            for frame in read:
                assert_same(form, stamps[frame.timestamp_ns], frame, labels=False)


def large(folder: Path, write: Callable[..., Path], **how: Any) -> Path:
    """Write 200 MB of images in any form."""
    camera = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
    rng = np.random.default_rng(0)
    depth = rng.integers(500, 4000, (480, 640), dtype=np.uint16)
    color = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    labels = np.ones((480, 640), np.uint16)
    frames = [
        RGBDFrame(n, 10**18 + n * INTERVAL_NS, depth, color, Calibration.registered(camera), labels)
        for n in range(110)
    ]
    return write(folder, frames, **how)


@pytest.mark.parametrize(
    ("write", "how"),
    [
        (robot, {"compression": CompressionType.NONE, "chunk_size": 1 << 20}),
        (robot, {"compression": CompressionType.NONE, "chunk_size": 1 << 20, "order": by_topic}),
        (robot, {"use_chunking": False}),
        (database, {}),
        (ros1, {}),
    ],
    ids=["mcap", "by topic", "unchunked", "db3", "bag"],
)
def test_memory_does_not_grow_with_a_recording(tmp_path: Path, write, how) -> None:
    path = large(tmp_path, write, **how)
    reading = read_bounded(path, frames_most=200)
    assert (reading.frames, reading.errors) == (110, [])
    # Opening takes about 100 MB; the images alone are 236 MB.
    assert reading.taken_bytes < 190e6, f"{reading.taken_bytes / 1e6:.0f} MB"


@pytest.mark.parametrize("name", ["ours-raw", "mcap-lz4", "mcap-none"])
def test_a_recording_whose_chunks_are_all_damaged_says_so(written, name, tmp_path):
    def damage(content: bytes) -> bytes:
        damaged = bytearray(content)
        for place in places(content, ".mcap", [Opcode.CHUNK]):
            damaged[place] ^= 0xFF
        return bytes(damaged)

    copy, _ = changed(written(name)[0], tmp_path, damage)
    with pytest.raises(RecordingFormatError, match=r"\.mcap: .*no message can be read"):
        open_source(copy)
