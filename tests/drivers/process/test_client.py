"""A camera read by a process of its own: the process, its words, and its end."""

import contextlib
import logging
import os
import signal
import time

import numpy as np
import pytest
from apart import apart
from busy_computer import slowdowns
from own_children import own_children
from virtual_camera import color_image, depth_image, frame_number

from nurbseg.common.errors import (
    BackendMissingError,
    CalibrationError,
    DeviceLostError,
    DeviceNotFoundError,
    DriverError,
    FrameTimeoutError,
)
from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.process import client
from nurbseg.drivers.process.messages import RecordOptions
from nurbseg.drivers.registry import open_source


def child():
    (process,) = own_children()
    return process


def assert_exact(frame, size=(640, 480), color_size=(640, 480), fps=30):
    number = frame_number(frame, fps)
    np.testing.assert_array_equal(frame.depth_mm, depth_image(number, *size))
    np.testing.assert_array_equal(frame.color, color_image(number, *color_size))


def test_it_is_the_same_camera_with_the_same_frames(virtual_cameras):
    virtual_cameras.add()
    with DeviceSource() as direct:
        metadata, calibration = direct.metadata, direct.calibration
    with apart() as source:
        assert source.live
        assert source.metadata == metadata
        np.testing.assert_array_equal(source.calibration.depth.matrix, calibration.depth.matrix)
        for index in range(20):
            frame = source.read()
            assert frame.index == index
            assert_exact(frame)


@pytest.mark.parametrize(
    ("depth_mode", "color_mode", "size", "color_size", "fps"),
    [
        ("qvga", "qvga", (320, 240), (320, 240), 60),
        ("vga", "sxga", (640, 480), (1280, 1024), 30),
    ],
)
def test_other_modes_fit_the_ring(virtual_cameras, depth_mode, color_mode, size, color_size, fps):
    virtual_cameras.add()
    with apart(options=DeviceOptions(depth_mode=depth_mode, color_mode=color_mode)) as source:
        for _ in range(3):
            assert_exact(source.read(), size, color_size, fps)


def test_a_reader_that_comes_late_loses_nothing(virtual_cameras):
    camera = virtual_cameras.add()
    missed = []
    for slowdown in slowdowns():
        camera.set(slowdown=slowdown)
        with apart() as source:
            first = source.read()
            time.sleep(0.7 * slowdown)
            frames = [source.read() for _ in range(25)]
        # Pictures that waited in the ring were not painted over.
        for frame in frames:
            assert_exact(frame)
        numbers = [frame_number(frame) for frame in (first, *frames)]
        assert numbers[-1] - numbers[0] - 25 == source.missed
        missed.append(source.missed)
        if missed[-1] <= 2:
            break
    assert min(missed) <= 2


def test_frames_before_the_first_read_are_not_missed_but_new(virtual_cameras):
    virtual_cameras.add()
    with apart() as source:
        time.sleep(1.5)
        frame = source.read()
        assert frame.index == 0
        assert frame_number(frame) > 30
        assert source.missed == 0
        assert not any(source.losses.values())
        source.read()


def test_frames_beyond_a_second_are_counted_as_missed(virtual_cameras):
    virtual_cameras.add()
    with apart() as source:
        source.read()
        time.sleep(2.0)
        numbers = [frame_number(source.read()) for _ in range(50)]
        assert source.missed >= 15
        assert numbers[-1] - numbers[0] + 1 - 50 <= source.missed


@pytest.mark.parametrize(
    ("wanted", "options", "error", "message"),
    [
        ("kinect", {}, DeviceNotFoundError, "openni2:kinect: no such camera"),
        ("any", {"depth_mode": "sxga"}, DriverError, "no 1280x1024@30 as DEPTH_1_MM"),
        ("any", {"calibration": "missing.toml"}, CalibrationError, "missing.toml"),
    ],
)
def test_errors_on_opening_are_those_of_the_camera(virtual_cameras, wanted, options, error, message):
    virtual_cameras.add()
    with pytest.raises(error, match=message):
        apart(wanted, DeviceOptions(**options))
    assert not own_children()


def test_a_missing_library_is_said_so(virtual_cameras, monkeypatch, tmp_path):
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(BackendMissingError, match="no libOpenNI2"):
        apart()


def test_warnings_come_through(virtual_cameras, caplog):
    virtual_cameras.add(registration="silent")
    with caplog.at_level(logging.WARNING), apart():
        pass
    assert "software does it instead" in caplog.text
    assert {record.name for record in caplog.records} == {"nurbseg.drivers.openni2.configuration"}


def test_a_crash_of_the_driver_is_a_lost_camera(virtual_cameras):
    virtual_cameras.add()
    with apart() as source:
        source.read()
        child().send_signal(signal.SIGSEGV)
        with pytest.raises(
            DeviceLostError, match="its driver crashed the source process, which ended by signal 11"
        ):
            while True:
                source.read()


def test_after_a_crash_the_camera_is_opened_again_and_its_recording_goes_on_in_a_further_part(
    virtual_cameras, tmp_path, caplog
):
    virtual_cameras.add()
    path = tmp_path / "a.mcap"
    with open_source("openni2:any", SourceOptions(every_frame=True)) as source:
        source.record(RecordOptions(path, color="raw"))
        before = [source.read() for _ in range(5)]
        child().send_signal(signal.SIGSEGV)
        deadline = time.monotonic() + 60.0
        while source.losses.get("reconnections", 0) == 0 or len(source.recordings) == 1:
            assert time.monotonic() < deadline
            with contextlib.suppress(FrameTimeoutError):
                before.append(source.read(0.5))
        after = [source.read(30.0) for _ in range(5)]
    frames = before + after
    assert [frame.index for frame in frames] == list(range(len(frames)))
    stamps = [frame.timestamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))
    assert [(part.path.name, part.ended, part.failure) for part in source.recordings] == [
        ("a.mcap", True, ""),
        ("a-2.mcap", True, ""),
    ]
    assert source.recordings[1].frames >= 5
    read = {frame.timestamp_ns: frame for frame in frames}
    for part in source.recordings:
        with open_source(part.path) as recording:
            same = [(each, read[each.timestamp_ns]) for each in recording if each.timestamp_ns in read]
        assert len(same) >= 1
        assert all((one.depth_mm == other.depth_mm).all() for one, other in same)
    assert "crashed the source process, which ended by signal 11; waiting for it to come back" in caplog.text


def test_a_hanging_driver_times_out_and_is_then_a_lost_camera(virtual_cameras, monkeypatch):
    monkeypatch.setattr(client, "_HANG_LIMIT_S", 1.3)
    virtual_cameras.add()
    with apart(options=DeviceOptions(silence_limit_s=1.0)) as source:
        source.read()
        process = child()
        process.suspend()
        with pytest.raises(FrameTimeoutError):
            while True:
                source.read(timeout_s=0.25)
        with pytest.raises(DeviceLostError, match="its driver hangs"):
            while True:
                try:
                    source.read(timeout_s=0.25)
                except FrameTimeoutError:
                    continue
        monkeypatch.setattr(client, "_END_LIMIT_S", 3.0)
    assert not process.is_running()


def test_images_are_paired_within_the_limit_of_the_options(virtual_cameras):
    virtual_cameras.add(color_delay_us=15000)
    options = SourceOptions(association_limit_s=0.005, device=DeviceOptions(sync=False))
    with open_source("openni2:any", options) as source, pytest.raises(FrameTimeoutError):
        source.read(timeout_s=1.0)


def test_closing_ends_the_process(virtual_cameras):
    virtual_cameras.add()
    source = apart()
    assert source.is_open()
    process = child()
    source.close()
    source.close()
    assert not source.is_open()
    assert not process.is_running()
    with pytest.raises(DriverError, match="closed"):
        source.read()


def test_the_process_ends_with_the_program(virtual_cameras):
    virtual_cameras.add()
    source = apart()
    process = child()
    # As when this program is killed: its end of the connection closes.
    source._process.channel.close()
    process.wait(60)
    source.close()


def test_interrupting_this_program_leaves_the_camera_alone(virtual_cameras):
    virtual_cameras.add()
    with apart() as source:
        assert os.getpgid(child().pid) != os.getpgid(0)
        source.read()


def test_a_damaged_image_is_reported_once_and_the_frames_after_it_come(virtual_cameras, caplog):
    # At 10 frames/s, a busy computer keeps up, too.
    virtual_cameras.add(slowdown=3, short_depth="12")
    numbers = []
    with caplog.at_level(logging.WARNING), apart() as source:
        while not numbers or numbers[-1] < 18:
            frame = source.read(5.0)
            assert_exact(frame)
            assert frame.index == len(numbers)
            numbers.append(frame_number(frame))
        status = source.status
    assert 12 not in numbers
    assert status.damaged == 1
    assert [each.split(":")[0] for each in status.damaged_frames] == ["depth frame 13"]
    assert caplog.text.count("skipped a damaged frame: depth frame 13:") == 1


def test_a_camera_that_gives_only_damaged_images_is_lost_at_a_limited_rate(virtual_cameras):
    virtual_cameras.add(short_depth="0-", low_color="0-")
    with apart(options=DeviceOptions(silence_limit_s=0.5)) as source:
        begin_s = time.monotonic()
        with pytest.raises(DeviceLostError, match=r"no depth and color for 5 s \((depth|color) frame"):
            source.read(60.0)
        # Two streams of 30 Hz.
        assert 10 < source.status.damaged < 100 * (time.monotonic() - begin_s)
        assert len(source.status.damaged_frames) == 20


def test_a_loop_that_takes_half_a_second_is_not_behind_a_real_driver(virtual_cameras):
    virtual_cameras.add()
    with open_source("openni2:any", SourceOptions()) as source:
        numbers, indices = [], []
        for frame in source:
            numbers.append(frame_number(frame))
            indices.append(frame.index)
            if len(numbers) == 6:
                break
            time.sleep(0.5)
        # In order, one by one, it would be at 5 now; some computers deliver less than 30 frames/s.
        assert numbers[-1] - numbers[0] > 25
        assert indices[-1] - indices[0] == source.missed + 5
        assert source.losses["missed"] <= numbers[-1] - numbers[0] - (indices[-1] - indices[0])
