"""The motor, the light and the accelerometer of a Kinect v1, over USB control transfers."""

import errno
import struct
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from nurbseg.common.closing import Closing
from nurbseg.common.errors import DeviceLostError, DeviceNotFoundError, DriverError
from nurbseg.drivers.doctor.usb import find_devices
from nurbseg.drivers.gravity import STANDARD_GRAVITY
from nurbseg.drivers.openni2.usb_ids import MICROSOFT

LedColor = Literal["off", "green", "red", "yellow", "blink-green", "blink-red-yellow"]
Movement = Literal["stopped", "at-limit", "moving", "unknown"]

TILT_MAX_DEG = 31

_MOTOR = 0x02B0
_MOTOR_OF_KINECT_FOR_WINDOWS = 0x02C2
_OUT = 0x40  # to the device, vendor request
_IN = 0xC0
_SET_LED = 0x06
_SET_TILT = 0x31
_GET_STATE = 0x32
_STATE_LENGTH = 10
_TIMEOUT_MS = 1000
_LED_VALUES: Final[dict[str, int]] = dict(zip(get_args(LedColor), (0, 1, 2, 3, 4, 6), strict=True))
_MOVEMENTS: Final[dict[int, Movement]] = {0: "stopped", 1: "at-limit", 4: "moving"}
_COUNTS_PER_G = 819.0
_TILT_UNKNOWN = -128  # while it moves


@dataclass(frozen=True, slots=True)
class MotorState:
    """Readings of the motor's sensors.

    The acceleration is the Kinect's against free fall: about (0, 9.81, 0) where it stands level. `tilt_deg`
    is the angle of the head above the horizon; None while the motor moves.
    """

    acceleration_m_s2: tuple[float, float, float]
    tilt_deg: float | None
    movement: Movement

    @property
    def acceleration_g(self) -> tuple[float, float, float]:
        """The acceleration in units of standard gravity."""
        x, y, z = (value / STANDARD_GRAVITY for value in self.acceleration_m_s2)
        return x, y, z


class KinectMotor(Closing):
    """The motor unit of a Kinect v1; constructing finds it, and it is usable until `close`.

    `backend` is what pyusb works through, libusb by default; `number` is which motor, from 0, where several
    are plugged in. Raises BackendMissingError if libusb is not installed, and DeviceNotFoundError if no such
    motor is plugged in.
    """

    def __init__(self, backend: Any = None, number: int = 0) -> None:
        kinects = [device for device in find_devices(backend) if device.idVendor == MICROSOFT]
        motors = [kinect for kinect in kinects if kinect.idProduct == _MOTOR]
        if not motors and any(kinect.idProduct == _MOTOR_OF_KINECT_FOR_WINDOWS for kinect in kinects):
            raise DeviceNotFoundError(
                "this is a Kinect for Windows or a late Kinect (model 1473): its motor answers only "
                "through its audio device, which is not supported"
            )
        if not 0 <= number < len(motors):
            raise DeviceNotFoundError(
                f"no Kinect v1 motor (045e:02b0) {'with number ' + str(number) + ' ' if motors else ''}"
                "is plugged in"
            )
        self._device = motors[number]

    def tilt(self, angle_deg: float) -> None:
        """Turn the head to an angle above the horizon, in steps of half a degree, without waiting for it.

        Raises ValueError if the angle is out of range, and DriverError if the motor does not take the
        command.
        """
        if not -TILT_MAX_DEG <= angle_deg <= TILT_MAX_DEG:
            raise ValueError(
                f"angle_deg: expected -{TILT_MAX_DEG} to {TILT_MAX_DEG} degrees, got {angle_deg:g}"
            )
        # The field is unsigned on the wire; the motor reads it as two's complement.
        self._transfer("moving the motor", _OUT, _SET_TILT, round(2 * angle_deg) & 0xFFFF)

    def led(self, color: LedColor) -> None:
        """Set the light, to one of the colors of `LedColor`."""
        if color not in _LED_VALUES:
            raise ValueError(f"color: expected one of {', '.join(_LED_VALUES)}, got {color!r}")
        self._transfer("setting the LED", _OUT, _SET_LED, _LED_VALUES[color])

    def state(self) -> MotorState:
        """Return the readings of the accelerometer and the motor."""
        answer = bytes(self._transfer("reading the accelerometer", _IN, _GET_STATE, 0, _STATE_LENGTH))
        if len(answer) != _STATE_LENGTH:
            raise DriverError(
                f"reading the accelerometer: expected {_STATE_LENGTH} bytes of the motor, got {len(answer)}"
            )
        x, y, z, half_degrees, movement = struct.unpack(">2xhhhbB", answer)
        scale = STANDARD_GRAVITY / _COUNTS_PER_G
        return MotorState(
            acceleration_m_s2=(x * scale, y * scale, z * scale),
            tilt_deg=None if half_degrees == _TILT_UNKNOWN else half_degrees / 2,
            movement=_MOVEMENTS.get(movement, "unknown"),
        )

    def _transfer(
        self, doing: str, direction: int, request: int, value: int, length: int | None = None
    ) -> Any:
        import usb.core

        try:
            return self._device.ctrl_transfer(direction, request, value, 0, length, _TIMEOUT_MS)
        except usb.core.USBError as err:
            if err.errno in (errno.EACCES, errno.EPERM):
                raise DriverError(
                    f"{doing}: no permission to open the Kinect's motor (045e:02b0); "
                    "'nurbseg-devices doctor' prints the udev rule for it"
                ) from err
            if err.errno in (errno.ENODEV, errno.ENOENT):
                raise DeviceLostError(f"{doing}: the Kinect was unplugged") from err
            raise DriverError(f"{doing}: {err}") from err

    def close(self) -> None:
        """Release the motor for other programs; safe to call twice."""
        import usb.util

        usb.util.dispose_resources(self._device)
