import errno

import pytest
from scripted_usb import KINECT_CAMERA, KINECT_FOR_WINDOWS_MOTOR, KINECT_MOTOR, ScriptedDevice, ScriptedUsb

from nurbseg.common.errors import DeviceLostError, DeviceNotFoundError, DriverError
from nurbseg.drivers.doctor.kinect_motor import KinectMotor

STATE = (0xC0, 0x32)


def motor_device(**options):
    return ScriptedDevice(KINECT_MOTOR, **options)


@pytest.mark.parametrize(
    ("angle_deg", "value"),
    [(0, 0), (10, 20), (31, 62), (-1, 0xFFFE), (-31, 0xFFC2), (0.5, 1), (-12.5, 0xFFE7)],
)
def test_the_tilt_is_sent_as_twice_the_angle_in_twos_complement(angle_deg, value):
    device = motor_device()
    with KinectMotor(ScriptedUsb(device)) as motor:
        motor.tilt(angle_deg)
    assert device.transfers == [(0x40, 0x31, value, 0, 1000)]
    assert not device.is_open


@pytest.mark.parametrize("angle_deg", [31.5, -32, 90, float("nan")])
def test_an_angle_out_of_range_is_refused_before_anything_is_sent(angle_deg):
    device = motor_device()
    with KinectMotor(ScriptedUsb(device)) as motor, pytest.raises(ValueError, match=r"-31 to 31"):
        motor.tilt(angle_deg)
    assert device.transfers == []


@pytest.mark.parametrize(
    ("color", "value"),
    [("off", 0), ("green", 1), ("red", 2), ("yellow", 3), ("blink-green", 4), ("blink-red-yellow", 6)],
)
def test_each_color_of_the_light_has_its_value(color, value):
    device = motor_device()
    with KinectMotor(ScriptedUsb(device)) as motor:
        motor.led(color)
    assert device.transfers == [(0x40, 0x06, value, 0, 1000)]


def test_an_unknown_color_is_refused_with_those_that_there_are():
    with KinectMotor(ScriptedUsb(motor_device())) as motor, pytest.raises(ValueError, match="blink-green"):
        motor.led("blue")


def test_the_state_is_read_as_big_endian_counts_half_degrees_and_status():
    # x = -819 counts, y = 819, z = 409; tilt -20 half degrees; moving.
    answer = bytes([0, 0, 0xFC, 0xCD, 0x03, 0x33, 0x01, 0x99, 0xEC, 4])
    device = motor_device(answers={STATE: answer})
    with KinectMotor(ScriptedUsb(device)) as motor:
        state = motor.state()
    assert device.transfers == [(0xC0, 0x32, 0, 0, 1000)]
    assert state.acceleration_m_s2 == pytest.approx((-9.80665, 9.80665, 409 / 819 * 9.80665))
    assert state.acceleration_g == pytest.approx((-1, 1, 409 / 819))
    assert state.tilt_deg == -10
    assert state.movement == "moving"


def test_while_the_motor_moves_the_angle_is_unknown():
    device = motor_device(answers={STATE: bytes(8) + bytes([0x80, 4])})
    with KinectMotor(ScriptedUsb(device)) as motor:
        assert motor.state().tilt_deg is None


def test_half_an_answer_is_an_error():
    device = motor_device(answers={STATE: bytes(6)})
    with KinectMotor(ScriptedUsb(device)) as motor, pytest.raises(DriverError, match=r"10 bytes.*got 6"):
        motor.state()


def test_without_a_motor_the_error_says_so():
    with pytest.raises(DeviceNotFoundError, match=r"no Kinect v1 motor \(045e:02b0\) is plugged in"):
        KinectMotor(ScriptedUsb(ScriptedDevice(KINECT_CAMERA)))


def test_a_kinect_for_windows_is_distinguished():
    with pytest.raises(DeviceNotFoundError, match="1473"):
        KinectMotor(ScriptedUsb(ScriptedDevice(KINECT_FOR_WINDOWS_MOTOR)))


def test_of_several_motors_the_requested_one_moves():
    first, second = motor_device(address=4), motor_device(address=5)
    with KinectMotor(ScriptedUsb(first, second), number=1) as motor:
        motor.tilt(5)
    assert (first.transfers, len(second.transfers)) == ([], 1)
    with pytest.raises(DeviceNotFoundError, match="number 2"):
        KinectMotor(ScriptedUsb(first, second), number=2)


@pytest.mark.parametrize(
    ("refusal", "error", "words"),
    [
        (errno.EACCES, DriverError, "no permission.*nurbseg-devices doctor"),
        (errno.ENODEV, DeviceLostError, "unplugged"),
        (errno.ETIMEDOUT, DriverError, "moving the motor"),
    ],
)
def test_a_refusal_says_what_was_tried_and_what_to_do(refusal, error, words):
    with (
        KinectMotor(ScriptedUsb(motor_device(open_errno=refusal))) as motor,
        pytest.raises(error, match=words),
    ):
        motor.tilt(3)
