"""A camera read by a process of its own: the process, its words, and its end."""

import logging
import os
import signal
import time

import numpy as np
import pytest
from busy_computer import slowdowns
from own_children import own_children
from virtual_camera import color_image, depth_image, frame_number

from nurbseg.common.errors import (
    BackendMissingError,
    CalibrationError,
    DeviceLostError,
    DeviceNotFoundError,
    DriverError,
    FrameFormatError,
    FrameTimeoutError,
)
from nurbseg.drivers.live.isolated import source as isolated
from nurbseg.drivers.live.isolated.source import IsolatedCamera
from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.options import DeviceOptions, SourceOptions
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
    with IsolatedCamera() as source:
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
    with IsolatedCamera(options=DeviceOptions(depth_mode=depth_mode, color_mode=color_mode)) as source:
        for _ in range(3):
            assert_exact(source.read(), size, color_size, fps)


def test_a_reader_that_comes_late_loses_nothing(virtual_cameras):
    camera = virtual_cameras.add()
    missed = []
    for slowdown in slowdowns():
        camera.set(slowdown=slowdown)
        with IsolatedCamera() as source:
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
    with IsolatedCamera() as source:
        time.sleep(1.5)
        frame = source.read()
        assert frame.index == 0
        assert frame_number(frame) > 30
        assert source.missed == source.half_pairs == 0
        source.read()


def test_frames_beyond_a_second_are_counted_as_missed(virtual_cameras):
    virtual_cameras.add()
    with IsolatedCamera() as source:
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
        IsolatedCamera(wanted, DeviceOptions(**options))
    assert not own_children()


def test_a_missing_library_is_said_so(virtual_cameras, monkeypatch, tmp_path):
    monkeypatch.setenv("OPENNI2_REDIST", str(tmp_path))
    with pytest.raises(BackendMissingError, match="no libOpenNI2"):
        IsolatedCamera()


def test_warnings_come_through(virtual_cameras, caplog):
    virtual_cameras.add(registration="silent")
    with caplog.at_level(logging.WARNING), IsolatedCamera():
        pass
    assert "software does it instead" in caplog.text
    assert {record.name for record in caplog.records} == {"nurbseg.drivers.openni2.configuration"}


def test_a_crash_of_the_driver_is_a_lost_camera(virtual_cameras):
    virtual_cameras.add()
    with IsolatedCamera() as source:
        source.read()
        child().send_signal(signal.SIGSEGV)
        with pytest.raises(DeviceLostError, match="crashed the camera's process, code -11"):
            while True:
                source.read()


def test_a_hanging_driver_times_out_and_is_then_a_lost_camera(virtual_cameras, monkeypatch):
    monkeypatch.setattr(isolated, "_HANG_LIMIT_S", 1.3)
    virtual_cameras.add()
    with IsolatedCamera(options=DeviceOptions(silence_limit_s=1.0)) as source:
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
        monkeypatch.setattr(isolated, "_END_LIMIT_S", 3.0)
    assert not process.is_running()


def test_a_frame_that_waits_is_read_without_any_time_to_wait(virtual_cameras, monkeypatch):
    virtual_cameras.add()
    with IsolatedCamera() as source:
        source.read()
        receive = source._channel.receive

        def receive_frame(timeout_s):
            while not isinstance(message := receive(10.0), isolated.CameraFrame):
                pass
            return message

        with monkeypatch.context() as patched:
            patched.setattr(source._channel, "receive", receive_frame)
            assert source.read(timeout_s=0.0).index == 1


def test_images_are_paired_within_the_limit_of_the_options(virtual_cameras):
    virtual_cameras.add(color_delay_us=15000)
    options = SourceOptions(association_limit_s=0.005, device=DeviceOptions(sync=False))
    with open_source("openni2:any", options) as source, pytest.raises(FrameTimeoutError):
        source.read(timeout_s=1.0)


def test_a_driver_that_hangs_while_the_camera_is_looked_for_is_given_up(virtual_cameras, monkeypatch):
    monkeypatch.setattr(isolated, "_OPEN_LIMIT_S", 5.0)
    with IsolatedCamera(patience_s=0.1) as source:
        begun_s = time.monotonic()
        while time.monotonic() - begun_s < 6.0:  # it is away, and that is said again and again
            assert not source.is_open(0.1)
        monkeypatch.setattr(isolated, "_OPEN_LIMIT_S", 0.5)
        monkeypatch.setattr(isolated, "_END_LIMIT_S", 3.0)
        child().suspend()
        with pytest.raises(DeviceLostError, match="its driver hangs"):
            while time.monotonic() - begun_s < 30.0:
                source.is_open(0.1)


def test_closing_ends_the_process(virtual_cameras):
    virtual_cameras.add()
    source = IsolatedCamera()
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
    source = IsolatedCamera()
    process = child()
    # As when this program is killed: its end of the connection closes.
    source._channel.close()
    process.wait(60)
    source.close()


def test_interrupting_this_program_leaves_the_camera_alone(virtual_cameras):
    virtual_cameras.add()
    with IsolatedCamera() as source:
        assert os.getpgid(child().pid) != os.getpgid(0)
        source.read()


def test_a_damaged_image_is_reported_once_and_the_frames_after_it_come(virtual_cameras):
    # At 10 frames/s, a busy computer keeps up, too.
    virtual_cameras.add(slowdown=3, short_depth="12")
    numbers, damaged = [], []
    with IsolatedCamera() as source:
        while not numbers or numbers[-1] < 18:
            try:
                frame = source.read(5.0)
            except FrameFormatError as err:
                damaged.append(str(err))
            else:
                assert_exact(frame)
                assert frame.index == len(numbers)
                numbers.append(frame_number(frame))
    assert 12 not in numbers
    assert [each.split(":")[0] for each in damaged] == ["depth frame 13"]


def test_a_camera_that_gives_only_damaged_images_is_lost_at_a_limited_rate(virtual_cameras):
    virtual_cameras.add(short_depth="0-", low_color="0-")
    with IsolatedCamera(options=DeviceOptions(silence_limit_s=0.5)) as source:
        damaged, begin_s = 0, time.monotonic()
        with pytest.raises(DeviceLostError, match=r"no depth and color for 5 s \((depth|color) frame"):
            while True:
                try:
                    source.read(1.0)
                except FrameFormatError:
                    damaged += 1
        # Two streams of 30 Hz.
        assert 10 < damaged < 100 * (time.monotonic() - begin_s)


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
