"""The writer of recordings: what it keeps, what it refuses, and what a kill leaves of a file."""

import logging
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_scene import APART, REGISTERED, scene, scenes, write_mcap

from nurbseg.drivers import Calibration, DriverError, Intrinsics, RecordingFormatError, open_source
from nurbseg.drivers.mcap import writer as ours
from nurbseg.drivers.mcap.ros_messages import LABELS_TOPIC
from nurbseg.drivers.mcap.writer import RecordingWriter

RERUN = [sys.executable, "-m", "rerun"]


def test_frames_without_ground_truth_come_back_without(tmp_path: Path) -> None:
    frames = [scene(0, labels=False), scene(1), scene(2, labels=False)]
    with open_source(write_mcap(tmp_path / "a.mcap", frames)) as source:
        assert [frame.labels is None for frame in source] == [True, False, True]


def test_each_frame_is_in_the_file_once_it_was_written(tmp_path: Path) -> None:
    # So small that all of it would wait in a buffer.
    tiny = Calibration.registered(Intrinsics(8, 6, 10.0, 10.0, 3.5, 2.5))
    path, copy = tmp_path / "a.mcap", tmp_path / "copy.mcap"
    with RecordingWriter(path, tiny, color_format="raw") as writer:
        for index in range(4):
            frame = scene(index, labels=False)
            writer.write(
                replace(frame, depth_mm=frame.depth_mm[:6, :8], color=frame.color[:6, :8], calibration=tiny)
            )
            copy.write_bytes(path.read_bytes())
            with open_source(copy) as source:
                assert len(list(source)) == index + 1


def test_each_frame_is_recorded_with_its_own_camera(tmp_path: Path) -> None:
    # As a lens that zooms has it.
    cameras = [replace(REGISTERED.depth, fx=50.0 + index) for index in range(3)]
    frames = [
        replace(scene(n), calibration=Calibration.registered(camera)) for n, camera in enumerate(cameras)
    ]
    with open_source(write_mcap(tmp_path / "a.mcap", frames)) as source:
        assert [frame.calibration.depth.fx for frame in source] == [50.0, 51.0, 52.0]
    with RecordingWriter(tmp_path / "b.mcap", REGISTERED) as writer:
        moved = replace(REGISTERED, color_from_depth=APART.color_from_depth)
        with pytest.raises(ValueError, match="color_from_depth: expected that of the recording"):
            writer.write(replace(scene(0), calibration=moved))


def test_more_labels_than_8_bits_hold_come_back(tmp_path: Path) -> None:
    labels = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64)
    with open_source(write_mcap(tmp_path / "a.mcap", [replace(scene(0), labels=labels)])) as source:
        np.testing.assert_array_equal(source.read().labels, labels)


def test_a_turn_of_any_kind_survives(tmp_path: Path) -> None:
    import cv2

    for number, axis in enumerate([(3.1, 0.2, 0), (0, np.pi, 0), (0.4, -2, 1), (0, 0, -np.pi)]):
        turned = np.eye(4)
        turned[:3, :3] = cv2.Rodrigues(np.array(axis, dtype=float))[0]
        calibration = replace(APART, color_from_depth=turned)
        path = write_mcap(tmp_path / f"{number}.mcap", [scene(0, calibration)])
        with open_source(path) as source:
            np.testing.assert_allclose(source.calibration.color_from_depth, turned, atol=1e-9)


def test_frames_of_another_size_and_times_before_zero_are_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", REGISTERED) as writer:
        with pytest.raises(ValueError, match="color: expected 64x48"):
            writer.write(scene(0, APART))
        with pytest.raises(ValueError, match="timestamp_ns"):
            writer.write(replace(scene(0), timestamp_ns=-1))
        writer.write(scene(0))
    with open_source(tmp_path / "a.mcap") as source:
        assert len(list(source)) == 1


def test_an_unknown_color_format_is_refused_before_a_file_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"jpeg95, png, raw.*'gif'"):
        RecordingWriter(tmp_path / "a.mcap", REGISTERED, color_format="gif")  # type: ignore[arg-type]
    assert not (tmp_path / "a.mcap").exists()


def test_writing_after_closing_is_an_error_and_closing_twice_is_not(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", REGISTERED)
    writer.close()
    writer.close()
    with pytest.raises(DriverError, match="closed"):
        writer.write(scene(0))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_reported_and_the_file_is_closed() -> None:
    with pytest.raises(OSError, match="No space left"):
        RecordingWriter(Path("/dev/full"), REGISTERED)


def test_a_disk_that_fills_up_is_reported_and_the_frames_before_can_be_replayed(tmp_path, caplog):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path, APART, color_format="raw")
    written = 0
    # The system refuses to let a file grow past this, as a full disk would.
    resource.setrlimit(resource.RLIMIT_FSIZE, (250_000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            for written in range(1000):
                frame = scene(written % 8, APART)
                noise = np.random.default_rng(written).integers(0, 255, frame.color.shape, dtype=np.uint8)
                writer.write(replace(frame, color=noise))
        with pytest.raises(OSError, match="File too large"):
            writer.close()
        writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.stat().st_size <= 250_000
    with caplog.at_level(logging.WARNING), open_source(path) as source:
        assert 0 < len(list(source)) <= written
    assert "cut off" in caplog.text


def test_an_empty_recording_says_that_it_has_no_images(tmp_path: Path) -> None:
    RecordingWriter(tmp_path / "a.mcap", REGISTERED).close()
    with pytest.raises(RecordingFormatError, match=r"a\.mcap: no topic of depth images"):
        open_source(tmp_path / "a.mcap")


def converted(path: Path) -> dict[str, set[str]]:
    """The components that Rerun makes of each topic."""
    from rerun.chunk import RrdReader

    rrd = path.with_suffix(".rrd")
    command = [*RERUN, "mcap", "convert", str(path), "-o", str(rrd)]
    subprocess.run(command, check=True, timeout=120, capture_output=True)
    found: dict[str, set[str]] = {}
    for chunk in RrdReader(rrd).stream():
        components = set(chunk.to_record_batch().schema.names)
        found.setdefault(str(chunk.entity_path), set()).update(components)
    return found


@pytest.mark.parametrize("color_format", ["jpeg95", "png", "raw"])
def test_rerun_is_content_with_it_and_finds_images_and_cameras(tmp_path, color_format):
    path = write_mcap(tmp_path / "a.mcap", scenes(3, APART), color_format)
    check = subprocess.run(
        [*RERUN, "mcap", "check", str(path)], timeout=120, capture_output=True, text=True, check=True
    )
    lines = [line for line in check.stdout.splitlines() if "/camera" in line or "/tf" in line]
    assert len(lines) == 6
    assert all(line.startswith("ok") and line.rstrip().endswith("—") for line in lines), check.stdout
    found = converted(path)
    assert "DepthImage:buffer" in found[ours.DEPTH_TOPIC]
    assert "Pinhole:image_from_camera" in found[ours.DEPTH_INFO_TOPIC]
    assert "Pinhole:image_from_camera" in found[ours.COLOR_INFO_TOPIC]
    assert "Transform3D:translation" in found[ours.TRANSFORMS_TOPIC]
    if color_format == "raw":
        assert "Image:buffer" in found[ours.COLOR_TOPIC]
    else:
        assert "EncodedImage:blob" in found[ours.COLOR_COMPRESSED_TOPIC]
    assert "EncodedImage:blob" in found[LABELS_TOPIC]
    assert "DepthImage:buffer" not in found[LABELS_TOPIC]
