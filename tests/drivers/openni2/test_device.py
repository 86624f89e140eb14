"""The device source over a real OpenNI2 with a virtual camera."""

import logging
import re
import time

import numpy as np
import pytest
from virtual_camera import color_image, depth_image, frame_number

from nurbseg.common.errors import DeviceLostError, DriverError, FrameFormatError
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers.calibration.file import write_calibration
from nurbseg.drivers.live.paired_camera import Image
from nurbseg.drivers.openni2 import configuration
from nurbseg.drivers.openni2.capi import Sensor
from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.options import DeviceOptions, parse_mode


def test_pixels_arrive_exactly_as_the_camera_shows_them_and_stay_so(virtual_cameras):
    virtual_cameras.add()
    with DeviceSource() as source:
        frames = [source.read() for _ in range(20)]
    for index, frame in enumerate(frames):
        number = frame_number(frame)
        assert frame.index == index
        np.testing.assert_array_equal(frame.depth_mm, depth_image(number))
        np.testing.assert_array_equal(frame.color, color_image(number))
        assert frame.calibration.is_registered


@pytest.mark.parametrize(
    ("kinds", "stamps_ms", "expected", "half_pairs"),
    [
        # At 30 images/s the limit is not quite 18 ms.
        (
            "ddcdcdcc",
            (0, 33, 66, 83, 100, 133, 115, 150),
            [None, None, None, (83, 66), None, None, None, (133, 150)],
            4,
        ),
        # Color that comes late finds the depth image of its time among newer ones, but none before a pair.
        ("ddcddcc", (0, 33, 2, 66, 100, 69, 35), [None, None, (0, 2), None, None, (66, 69), None], 1),
        # Not more than three wait.
        ("ddddc", (0, 33, 66, 100, 2), [None] * 5, 1),
    ],
)
def test_an_image_whose_other_half_did_not_come_gives_way_to_the_next_and_is_counted(
    virtual_cameras, kinds, stamps_ms, expected, half_pairs
):
    virtual_cameras.add()
    with DeviceSource() as source:
        pairs = []
        for kind, stamp_ms in zip(kinds, stamps_ms, strict=True):
            image = Image(1000 * stamp_ms, stamp_ms, np.zeros((480, 640)))
            pair = source._add(image, is_depth=kind == "d")
            pairs.append(pair and tuple(each.number for each in pair))
        assert pairs == expected
        assert source.half_pairs == half_pairs


def test_depth_images_that_never_came_are_counted(virtual_cameras):
    virtual_cameras.add(slowdown=30)
    with DeviceSource() as source:
        source._settling = 0
        for number, missed in ((7, 0), (8, 0), (11, 2), (12, 2), (1, 2), (3, 3)):
            source._add(Image(33_000 * number, number, np.zeros((480, 640))), is_depth=True)
            source._add(Image(33_000 * number, 2 * number, np.zeros((480, 640))), is_depth=False)
            assert source.missed == missed
        assert source.losses == {"missed": 3, "half_pairs": 0}


@pytest.mark.parametrize(
    ("depth_mode", "color_mode", "size", "color_size", "fps"),
    [
        ("vga", "vga", (640, 480), (640, 480), 30),
        ("qvga", "qvga", (320, 240), (320, 240), 60),
        ("vga", "sxga", (640, 480), (1280, 1024), 30),
        ("320x240@30", "640x480@30", (320, 240), (640, 480), 30),
    ],
)
def test_each_listed_mode_is_delivered(virtual_cameras, depth_mode, color_mode, size, color_size, fps):
    virtual_cameras.add()
    with DeviceSource(options=DeviceOptions(depth_mode=depth_mode, color_mode=color_mode)) as source:
        first, second = source.read(), source.read()
        steps = frame_number(second, fps) - frame_number(first, fps)
        assert 1 <= steps <= 1 + source.missed
        for frame in (first, second):
            number = frame_number(frame, fps)
            np.testing.assert_array_equal(frame.depth_mm, depth_image(number, *size))
            np.testing.assert_array_equal(frame.color, color_image(number, *color_size))


def test_streams_of_different_rates_are_not_synchronized_but_paired_by_time(virtual_cameras):
    virtual_cameras.add()
    with DeviceSource(options=DeviceOptions(depth_mode="320x240@60", color_mode="vga")) as source:
        assert source.metadata["sync"] == "off"
        for _ in range(5):
            frame = source.read()
            number = frame_number(frame, fps=60)
            np.testing.assert_array_equal(frame.depth_mm, depth_image(number, 320, 240))
            nearby = [color_image(n) for n in (number // 2, (number + 1) // 2)]
            assert any(np.array_equal(frame.color, image) for image in nearby)


def test_intrinsics_follow_from_the_field_of_view(virtual_cameras):
    virtual_cameras.add(fov_horizontal=1.0)
    with DeviceSource() as source:
        camera = source.calibration.depth
    assert camera.fx == pytest.approx(320 / np.tan(0.5), rel=1e-6)
    assert camera.fy == camera.fx
    assert (camera.cx, camera.cy) == (319.5, 239.5)


def test_an_sxga_image_continues_below_the_view_of_the_vga_image(virtual_cameras):
    virtual_cameras.add()
    with DeviceSource(options=DeviceOptions(color_mode="sxga")) as source:
        color, depth = source.calibration.color, source.calibration.depth
    assert color.fx == pytest.approx(2 * depth.fx)
    # The same ray, through both images: pixel centers of the double size are half a pixel apart.
    assert color.cy + 0.5 == pytest.approx(2 * (depth.cy + 0.5))
    assert not np.any(source.calibration.color_from_depth - np.eye(4))


def test_depth_in_tenths_of_a_millimetre_is_rounded_to_millimeters(virtual_cameras):
    virtual_cameras.add()
    with DeviceSource(options=DeviceOptions(depth_unit="100um")) as source:
        frame = source.read()
        assert source.metadata["depth_mode"] == "640x480@30 DEPTH_100_UM"
    columns = np.arange(640)
    rounding_up = columns % 10 >= 5  # the camera's last digit is the column's
    expected = depth_image(frame_number(frame)) + rounding_up.astype(np.uint16)
    np.testing.assert_array_equal(frame.depth_mm, expected)


@pytest.mark.parametrize(
    ("camera", "options", "shown", "stated"),
    [
        # Whatever the camera does, images are mirrored only on request.
        *(
            ({"mirror": behavior}, {"mirror": mirror}, {"mirrored": mirror}, {})
            for behavior in ("obeys", "stuck")
            for mirror in (False, True)
        ),
        # It ignores registration before the streams started.
        ({"registration": "on"}, {}, {"registered": True}, {"registration": "hardware"}),
        ({}, {"registration": "software"}, {"registered": False}, {"registration": "software"}),
        # Another program left it behind.
        ({"cropped": 1}, {}, {}, {}),
    ],
)
def test_images_are_those_of_the_settings(virtual_cameras, camera, options, shown, stated):
    virtual_cameras.add(**camera)
    with DeviceSource(options=DeviceOptions(**options)) as source:
        frame = source.read()
        assert source.metadata.items() >= stated.items()
    number, mirrored = frame_number(frame), {"mirrored": shown.get("mirrored", False)}
    np.testing.assert_array_equal(frame.depth_mm, depth_image(number, **shown))
    np.testing.assert_array_equal(frame.color, color_image(number, **mirrored))


def calibration_file(folder, calibration):
    path = folder / "camera.toml"
    write_calibration(path, calibration)
    return str(path)


def test_depth_and_color_are_each_mirrored_where_the_camera_does_not(virtual_cameras, monkeypatch):
    virtual_cameras.add()
    must_flip = configuration._must_flip

    def must_flip_color(stream, mirror):
        return must_flip(stream, mirror) or stream.sensor == Sensor.COLOR

    monkeypatch.setattr(configuration, "_must_flip", must_flip_color)
    with DeviceSource() as source:
        frame = source.read()
    number = frame_number(frame)
    np.testing.assert_array_equal(frame.depth_mm, depth_image(number))
    np.testing.assert_array_equal(frame.color, color_image(number)[:, ::-1])


@pytest.mark.parametrize("registration", ["silent", "refused", "absent"])
def test_software_registers_where_the_camera_does_not(virtual_cameras, registration, caplog):
    virtual_cameras.add(registration=registration)
    with caplog.at_level(logging.WARNING), DeviceSource() as source:
        assert source.metadata["registration"] == "software"
        frame = source.read()
    assert "software does it instead" in caplog.text
    assert "nominal values" in caplog.text
    np.testing.assert_array_equal(frame.depth_mm, depth_image(frame_number(frame), registered=False))
    assert not frame.calibration.is_registered
    assert frame.calibration.color.fx == 525.0
    np.testing.assert_allclose(frame.calibration.color_from_depth[:3, 3], [-0.025, 0, 0])


@pytest.mark.parametrize("mirror", [False, True])
def test_a_given_calibration_is_used_and_mirrored_with_the_images(virtual_cameras, tmp_path, mirror):
    virtual_cameras.add()
    camera = Intrinsics(640, 480, 520.0, 521.0, 310.0, 242.0)
    given = Calibration(depth=Intrinsics(640, 480, 580.0, 581.0, 315.0, 244.0), color=camera)
    file = calibration_file(tmp_path, given)
    options = DeviceOptions(registration="software", calibration=file, mirror=mirror)
    with DeviceSource(options=options) as source:
        depth, color = source.calibration.depth, source.calibration.color
    assert (depth.fx, color.fx, depth.cx) == (580.0, 520.0, 324.0 if mirror else 315.0)


def test_a_given_calibration_is_used_for_registered_images_of_another_size(virtual_cameras, tmp_path):
    virtual_cameras.add()
    camera = Intrinsics(640, 480, 520.0, 521.0, 310.0, 242.0)
    file = calibration_file(tmp_path, Calibration.registered(camera))
    options = DeviceOptions(depth_mode="qvga", color_mode="qvga", calibration=file)
    with DeviceSource(options=options) as source:
        assert source.calibration.is_registered
        assert source.calibration.depth.fx == 260.0
        assert source.read().depth_mm.shape == (240, 320)


@pytest.mark.parametrize("formats", ["yuv422", "yuyv", "gray8"])
def test_other_color_formats_become_rgb(virtual_cameras, formats):
    virtual_cameras.add(color_formats=formats)
    with DeviceSource() as source:
        frame = source.read()
    # These streams are gray, with the pattern's red channel as luminance; YUV has its own black and white.
    red = color_image(frame_number(frame))[..., 0].astype(float)
    expected = red if formats == "gray8" else np.clip((red - 16) * 255 / 219, 0, 255)
    for channel in range(3):
        np.testing.assert_allclose(frame.color[..., channel], expected, atol=1.5)


def test_color_controls_are_set_and_read_back(virtual_cameras, caplog):
    virtual_cameras.add()
    options = DeviceOptions(auto_exposure="off", auto_white_balance="off", exposure=42, gain=7)
    with caplog.at_level(logging.WARNING), DeviceSource(options=options) as source:
        told = {
            name: source.metadata[name]
            for name in ("auto_exposure", "auto_white_balance", "exposure", "gain")
        }
    assert told == {"auto_exposure": "0", "auto_white_balance": "0", "exposure": "42", "gain": "7"}
    assert not caplog.text


def test_color_controls_that_the_camera_lacks_are_said_so(virtual_cameras, caplog):
    virtual_cameras.add(controls=0)
    with caplog.at_level(logging.WARNING), DeviceSource(options=DeviceOptions(gain=7)):
        pass
    assert "does not accept gain 7" in caplog.text


def test_a_mode_that_is_not_listed_is_refused_with_what_is(virtual_cameras):
    virtual_cameras.add()
    with pytest.raises(DriverError, match="no 1280x1024@30 as DEPTH_1_MM; it lists 640x480@30"):
        DeviceSource(options=DeviceOptions(depth_mode="sxga"))


def test_a_mode_that_the_camera_refuses_is_named(virtual_cameras):
    virtual_cameras.add(refuse_color_mode="1280x1024@30")
    with pytest.raises(DriverError, match="setting the color stream to 1280x1024@30 RGB888"):
        DeviceSource(options=DeviceOptions(color_mode="sxga"))
    with DeviceSource() as source:
        source.read()


def test_a_camera_without_color_is_refused(virtual_cameras):
    virtual_cameras.add(color=0)
    with pytest.raises(DriverError, match="no color stream"):
        DeviceSource()


@pytest.mark.parametrize(
    ("text", "mode"),
    [
        ("640x480@30", (640, 480, 30)),
        ("320x240", (320, 240, 30)),
        ("VGA", (640, 480, 30)),
        ("qvga", (320, 240, 60)),
        ("qvga30", (320, 240, 30)),
        ("sxga@15", (1280, 1024, 15)),
    ],
)
def test_modes_are_read_from_words(text, mode):
    assert parse_mode(text) == mode


def test_a_mode_that_cannot_be_read_names_its_option():
    with pytest.raises(ValueError, match=r"color_mode: expected a mode such as 640x480@30.*'4k'"):
        DeviceOptions(color_mode="4k")


def read_with_damage(last):
    """Read frames up to a number; return their numbers, what was said of damaged ones, and the missed."""
    numbers, damaged = [], []
    with DeviceSource() as source:
        while not numbers or numbers[-1] < last:
            try:
                frame = source.read(10.0)
            except FrameFormatError as err:
                damaged.append(str(err))
                continue
            numbers.append(frame_number(frame))
            assert np.array_equal(frame.depth_mm, depth_image(numbers[-1]))
        return numbers, damaged, source.missed


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        ({"short_depth": "6,9-10"}, "depth frame 7: 640x480 DEPTH_1_MM, 1280 bytes a row, does not fit"),
        ({"short_color": "6,9-10"}, "color frame 7: 640x480 RGB888, 1920 bytes a row, does not fit"),
        ({"low_depth": "6,9-10"}, "depth frame 7: 640x240 pixels, expected 640x480"),
        ({"low_color": "6,9-10"}, "color frame 7: 640x240"),
    ],
)
def test_a_damaged_image_costs_its_own_frame_only(virtual_cameras, damage, reason):
    camera = virtual_cameras.add(**damage)
    # A busy computer needs a slower camera: it has to have good frames before the damaged ones.
    for slowdown in (3, 12):
        camera.set(slowdown=slowdown)
        numbers, damaged, missed = read_with_damage(14)
        if numbers[0] <= 5 and not missed:
            break
    assert missed == numbers[-1] - numbers[0] + 1 - len(numbers) - 3
    assert not {6, 9, 10} & set(numbers)
    assert {5, 7, 8, 11} <= set(numbers)
    assert len(damaged) == 3
    assert damaged[0].startswith(reason)


def test_a_camera_that_gives_only_damaged_images_is_lost_and_why_is_said(virtual_cameras):
    # Slow, so that a busy computer has good frames before the damaged ones.
    virtual_cameras.add(slowdown=3, short_depth="8-", short_color="8-")
    deadline_s = time.monotonic() + 60.0
    with DeviceSource(options=DeviceOptions(silence_limit_s=0.5)) as camera:
        while time.monotonic() < deadline_s:
            try:
                camera.read()
            except FrameFormatError:
                continue
            except DeviceLostError as err:
                assert re.search(r"no depth and color for 0.5 s \((color|depth) frame \d+: 640x480", str(err))
                return
    pytest.fail("never lost")


def test_the_first_pairs_were_still_taken_with_the_settings_of_before(virtual_cameras):
    # So slow that none is overwritten before it is read.
    virtual_cameras.add(slowdown=8)
    with DeviceSource() as source:
        assert frame_number(source.read(10.0)) == 2
        assert frame_number(source.read(10.0)) == 3
