"""Recordings by OpenNI2's recorder, replayed by OpenNI2's file driver; and files that are damaged."""

import logging
import os
import signal
import time

import numpy as np
import pytest
from own_children import own_children
from recorded_oni import RecordedCamera, record_ten_frames
from virtual_camera import color_image, depth_image, frame_number

from nurbseg.common.errors import EndOfRecordingError, FrameTimeoutError, RecordingFormatError
from nurbseg.drivers.openni2.oni import playback
from nurbseg.drivers.openni2.oni.playback import OniSource
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.testing import SourceContract


def record(path, options=None, frames=12, lossy=False):
    """Record from the only camera; return its calibration and the last frame's number."""
    with RecordedCamera(options=options) as source:
        source.record(path, lossy=lossy)
        for _ in range(frames):
            frame = source.read()
        source.finish()
        return source.calibration, frame_number(frame)


def replay(path, **options):
    with OniSource(path, SourceOptions(device=DeviceOptions(**options))) as source:
        return list(source)


@pytest.fixture
def recording(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "clip.oni"
    record(path)
    return path


def assert_exact(frames, registered=True, first=None):
    """Each frame is the camera's next one, in depth and color, from its first on."""
    for position, frame in enumerate(frames):
        number = frame_number(frame)
        assert frame.index == position
        assert number == (frame_number(frames[0]) if first is None else first) + position
        np.testing.assert_array_equal(frame.depth_mm, depth_image(number, registered=registered))
        np.testing.assert_array_equal(frame.color, color_image(number))


def test_a_recording_replays_exactly_and_whole(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "clip.oni"
    calibration, last = record(path, frames=30)
    with open_source(str(path)) as source:
        assert not source.live
        frames = list(source)
        assert source.half_pairs <= 1  # the recorder may stop between the two halves
        with pytest.raises(EndOfRecordingError):
            source.read()
    # From the camera's first frame to at least the last one that was seen live.
    assert_exact(frames, first=0)
    assert len(frames) > last
    assert frames[0].timestamp_ns == 0
    for camera in ("depth", "color"):
        replayed, live = getattr(frames[0].calibration, camera), getattr(calibration, camera)
        np.testing.assert_array_equal(replayed.matrix, live.matrix)
    assert frames[0].calibration.is_registered


class TestContract(SourceContract):
    """The recording goes to any frame from anywhere, skips, ends, and leaves no process."""

    @pytest.fixture(autouse=True)
    def opened(self, recording):
        self.path = recording
        with OniSource(recording) as source:
            self.frames = len(source)
        yield
        assert not own_children()

    def open(self):
        return open_source(str(self.path))


def shown(folder, name, image):
    """Return a folder of raw images for a camera to show."""
    (folder / "raw").mkdir()
    (folder / "raw" / f"{name}_0000.raw").write_bytes(image.tobytes())
    return folder / "raw"


def test_lossy_color_is_close_and_depth_exact(virtual_cameras, tmp_path):
    # JPEG is made for pictures, so this camera shows a smooth one.
    row, col = np.mgrid[:480, :640]
    smooth = np.stack([row / 2, col / 3, (row + col) / 5], axis=-1).astype(np.uint8)
    virtual_cameras.add(frames=shown(tmp_path, "color", smooth))
    record(tmp_path / "clip.oni", frames=5, lossy=True)
    for frame in replay(tmp_path / "clip.oni"):
        np.testing.assert_array_equal(frame.depth_mm, depth_image(frame_number(frame)))
        error = frame.color.astype(float) - smooth
        assert 10 * np.log10(255**2 / np.mean(error**2)) > 30
    assert (tmp_path / "clip.oni").stat().st_size < 5 * smooth.nbytes


@pytest.mark.parametrize(("per_meter", "stored"), [(1000, "1mm"), (10_000, "100um")])
def test_the_unit_is_that_of_the_recording_or_the_users(virtual_cameras, tmp_path, per_meter, stored, caplog):
    # The format holds 32767 different depths an image, fewer than the usual pattern has in tenths.
    depth = np.broadcast_to(np.arange(480, dtype=np.uint16)[:, None] * 2 + 1000, (480, 640))
    virtual_cameras.add(frames=shown(tmp_path, "depth", depth))
    record(tmp_path / "clip.oni", DeviceOptions(depth_unit=stored), frames=3)
    # In the recording, one of the camera's millimeters is a unit, or ten and its last digit.
    units = depth if stored == "1mm" else depth.astype(int) * 10 + np.arange(640) % 10
    for given in (None, float(per_meter), 2.0 * per_meter):
        with OniSource(tmp_path / "clip.oni", SourceOptions(depth_scale=given)) as source:
            frame = source.read(5.0)
            assert ("--depth-scale" in source.metadata["depth_unit"]) is (given is not None)
        assert np.abs(frame.depth_mm - units * (1000 / (given or per_meter))).max() <= 0.5
    assert "OpenNI2's own" in caplog.text


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize(("mode", "size"), [("vga", (640, 480)), ("qvga", (320, 240))])
def test_modes_and_mirrored_recordings_replay_as_wanted(virtual_cameras, tmp_path, mirror, mode, size):
    virtual_cameras.add()
    path = tmp_path / "clip.oni"
    record(path, DeviceOptions(mirror=mirror, depth_mode=mode, color_mode=mode), frames=5)
    for wanted in (False, True):
        for frame in replay(path, mirror=wanted)[:2]:
            number = frame_number(frame, 30 if mode == "vga" else 60)
            np.testing.assert_array_equal(frame.depth_mm, depth_image(number, *size, mirrored=wanted))
            np.testing.assert_array_equal(frame.color, color_image(number, *size, mirrored=wanted))


def test_dropped_images_are_left_out_when_replayed(virtual_cameras, tmp_path):
    virtual_cameras.add(drop_color="4,7-8", drop_depth="10")
    path = tmp_path / "clip.oni"
    record(path, DeviceOptions(sync=False), frames=12)
    frames = replay(path)
    numbers = [frame_number(frame) for frame in frames]
    assert not {4, 7, 8, 10} & set(numbers)
    assert numbers == sorted(set(range(numbers[-1] + 1)) - {4, 7, 8, 10})
    for frame, number in zip(frames, numbers, strict=True):
        np.testing.assert_array_equal(frame.depth_mm, depth_image(number))
        np.testing.assert_array_equal(frame.color, color_image(number))


def test_a_killed_recording_replays_to_its_last_frame(virtual_cameras, tmp_path, caplog):
    virtual_cameras.add()
    path, killed = tmp_path / "clip.oni", tmp_path / "killed.oni"
    killed.write_bytes(record_ten_frames(path))
    with caplog.at_level(logging.WARNING):
        frames = replay(killed)
    assert "is truncated" in caplog.text
    assert len(frames) >= 5
    assert_exact(frames, first=0)


END = b"NIR\0\x0b\0\0\0"


def cut(share):
    return lambda content: content[: int(content.rindex(END) * share)]


def wrong_size(content):
    """The first color image: type 10 of node 2; its payload's size is at offset 16."""
    at = content.index(b"NIR\0\x0a\0\0\0\x02\0\0\0")
    return content[: at + 16] + (921599).to_bytes(4, "little") + content[at + 20 :]


NO_FRAMES = "depth: the recording holds no frames before it breaks off"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (cut(0.001), NO_FRAMES),
        *((cut(share), "OpenNI2 cannot play it .*only part of the file was copied") for share in (0.3, 0.95)),
        (lambda content: content.replace(b"NIR\0", b"NIQ\0", 1), NO_FRAMES),
        (lambda content: b"NI10" + bytes(20), NO_FRAMES),
        (lambda content: b"NI10" + bytes(4000), NO_FRAMES),
        (lambda content: b"", "header: not an OpenNI recording"),
        (lambda content: b"NI10", "header: not an OpenNI recording"),
        (lambda content: b"RIFF" + bytes(100), "header: not an OpenNI recording"),
    ],
)
def test_a_damaged_file_is_refused_by_name(recording, change, said):
    recording.write_bytes(change(recording.read_bytes()))
    with pytest.raises(RecordingFormatError, match=rf"clip\.oni: {said}"):
        OniSource(recording)


def test_an_image_of_a_wrong_size_ends_the_recording_before_it(recording):
    recording.write_bytes(wrong_size(recording.read_bytes()))
    with pytest.raises(RecordingFormatError, match=r"clip\.oni: "):
        assert_exact(replay(recording), first=0)


def test_garbage_never_crashes_or_hangs(recording, rng, monkeypatch):
    """A byte here and there, a block, and the whole of the frames: an error of ours, or frames."""
    monkeypatch.setattr(playback, "_HANG_LIMIT_S", 2.0)
    sound = recording.read_bytes()
    for trial in range(30):
        content = bytearray(sound)
        if trial < 15:  # in the descriptions, which the driver trusts most
            for _ in range(1 + trial // 3):
                content[rng.integers(24, 2100)] = rng.integers(256)
        elif trial < 25:
            begin = int(rng.integers(2100, len(content) - 5000))
            content[begin : begin + 4000] = rng.bytes(4000)
        else:
            content[2100:] = rng.bytes(len(content) - 2100)
        recording.write_bytes(content)
        begun = time.monotonic()
        try:
            with OniSource(recording) as source:
                for frame in source:
                    assert frame.depth_mm.shape == (480, 640)
        except (RecordingFormatError, FrameTimeoutError) as err:
            assert "clip.oni" in str(err)
        assert time.monotonic() - begun < 60


def test_a_player_that_crashes_is_a_damaged_file(recording):
    with OniSource(recording) as source:
        source.read()
        os.kill(own_children()[0].pid, signal.SIGSEGV)
        with pytest.raises(RecordingFormatError, match="stopped with code -11; the file is damaged"):
            while True:
                source.read()


def test_a_player_that_hangs_times_out_and_is_then_given_up(recording, monkeypatch):
    monkeypatch.setattr(playback, "_HANG_LIMIT_S", 0.6)
    with OniSource(recording) as source:
        source.read()
        os.kill(own_children()[0].pid, signal.SIGSTOP)
        with pytest.raises(FrameTimeoutError):
            while True:  # some frames are in the pipe already
                source.read(timeout_s=0.3)
        with pytest.raises(RecordingFormatError, match="hangs on it"):
            for _ in range(5):
                try:
                    source.read(timeout_s=0.3)
                except FrameTimeoutError:
                    continue


def test_a_slow_reader_loses_nothing(recording):
    with OniSource(recording) as source:
        frames = []
        for frame in source:
            frames.append(frame)
            time.sleep(0.02)
        assert len(frames) == len(source)
    assert_exact(frames, first=0)


def test_a_recording_is_taken_as_registered_unless_said_otherwise(recording, caplog):
    with caplog.at_level(logging.WARNING):
        assert replay(recording)[0].calibration.is_registered
    assert "does not say whether depth is registered to color; taken as registered" in caplog.text
    assert not replay(recording, registration="software")[0].calibration.is_registered


def test_given_intrinsics_count_before_the_recordings(recording):
    options = SourceOptions(intrinsics=(600.0, 601.0, 320.0, 240.0))
    with open_source(recording, options) as source:
        assert source.calibration.color.fy == source.read().calibration.depth.fy == 601.0
        assert int(source.metadata["dropped"]) == source.half_pairs
