"""The SDK, the cameras that it finds, and what they state of themselves."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import BackendMissingError, CalibrationError, DeviceNotFoundError, DriverError
from nurbseg.common.frame import Calibration, Intrinsics

INSTALL = "RealSense cameras need their SDK: pip install 'nurbseg[realsense]'"
#: Distortion models with OpenCV's coefficients: the SDK itself projects by all three as Brown and Conrady do.
_BROWN = ("brown_conrady", "inverse_brown_conrady", "modified_brown_conrady")


def load() -> Any:
    """Return the module of the SDK.

    Raises BackendMissingError, which says how to install it, and DriverError if it is there but fails.
    """
    try:
        import pyrealsense2
    except ImportError as err:
        if "libusb" in str(err):
            raise BackendMissingError(
                f"the RealSense SDK needs libusb: apt install libusb-1.0-0 ({err})"
            ) from err
        raise BackendMissingError(f"{INSTALL} ({err})") from err
    except Exception as err:  # A damaged installation may raise anything.
        raise DriverError(f"the RealSense SDK cannot be loaded ({type(err).__name__}: {err})") from err
    return pyrealsense2


@dataclass(frozen=True, slots=True)
class Listing:
    """What a camera states of itself; what it does not is empty.

    `usb` is the version of USB that connects it ("3.2", "2.1"), `newest` the firmware that is recommended.
    """

    name: str
    serial: str
    firmware: str
    newest: str
    usb: str
    port: str
    product: str

    @property
    def doubts(self) -> tuple[str, ...]:
        """What may keep it from working well, and what to do."""
        found = []
        if self.usb.startswith("2"):
            found.append(
                f"is connected by USB {self.usb}, which has room for few modes: use a USB 3 port, and a "
                "cable for it"
            )
        if _version(self.firmware) < _version(self.newest):
            found.append(
                f"has firmware {self.firmware}, older than {self.newest}: update it by realsense-viewer or "
                "rs-fw-update"
            )
        return tuple(found)


def describe(rs: Any, device: Any) -> Listing:
    """Return what a device states of itself."""
    names = (
        "name",
        "serial_number",
        "firmware_version",
        "recommended_firmware_version",
        "usb_type_descriptor",
        "physical_port",
        "product_id",
    )
    keys = [getattr(rs.camera_info, name) for name in names]
    return Listing(*(str(device.get_info(key)) if device.supports(key) else "" for key in keys))


def find(rs: Any, wanted: str) -> tuple[Any, Any]:
    """Return a context, and its device with a serial number, or of no number the first that can be opened.

    Raises DeviceNotFoundError, which names those that are there.
    """
    name = f"realsense:{wanted}".removesuffix(":")
    try:
        context = rs.context()
        devices = list(context.query_devices())
        listings = [describe(rs, device) for device in devices]
    except RuntimeError as err:
        raise DeviceNotFoundError(f"{name}: the SDK could not list its cameras ({err})") from err
    word = wanted.strip()
    for device, listing in zip(devices, listings, strict=True):
        if word.lower() in ("", "any") or word == listing.serial:
            return context, device
    present = ", ".join(f"{listing.name} (serial {listing.serial})" for listing in listings) or "none"
    raise DeviceNotFoundError(f"{name}: no such camera; connected: {present}")


def video_modes(device: Any) -> Iterator[tuple[str, str, tuple[int, int, int], Any, Any]]:
    """Yield the kind, format and mode of the profiles of images, and their sensor and profile."""
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type().name in ("depth", "color"):
                video = profile.as_video_stream_profile()
                mode = video.width(), video.height(), profile.fps()
                yield profile.stream_type().name, profile.format().name, mode, sensor, profile


def choose_profile(device: Any, kind: str, mode: tuple[int, int, int]) -> tuple[Any, Any]:
    """Return the sensor and the profile of a stream, "depth" or "color", in a mode.

    Raises DriverError, which lists the modes that there are.
    """
    forms = {"depth": ("z16",), "color": ("rgb8", "bgr8", "yuyv")}[kind]
    there = [each for each in video_modes(device) if each[0] == kind and each[1] in forms]
    found = [each for each in there if each[2] == mode]
    if not found:
        text = ", ".join("{}x{}@{}".format(*each) for each in sorted({each[2] for each in there})) or "none"
        wanted = "{}x{}@{}".format(*mode)
        raise DriverError(f"the camera has no {kind} of {wanted}; --{kind}-mode can be: {text}")
    *_, sensor, profile = min(found, key=lambda each: forms.index(each[1]))
    return sensor, profile


def accelerometer(rs: Any, device: Any, depth: Any) -> tuple[Any, Any, NDArray[np.float64]] | None:
    """Return the accelerometer, its slowest profile, and the turn (3, 3) from its axes to those of depth.

    None for a camera without one, or that does not state how it lies.
    """
    found = [
        (profile.fps(), sensor, profile)
        for sensor in device.query_sensors()
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.accel
    ]
    if not found:
        return None
    _, sensor, profile = min(found, key=lambda each: each[0])
    try:
        rotation = profile.get_extrinsics_to(depth).rotation
    except RuntimeError:
        return None
    # By columns.
    return sensor, profile, np.array(rotation, dtype=np.float64).reshape(3, 3).T


def calibration_of(name: str, depth: Any, color: Any) -> Calibration:
    """Return what the camera states of two streams.

    Raises CalibrationError if a lens has no model of OpenCV's, or a value is unusable.
    """
    extrinsics = depth.get_extrinsics_to(color)
    color_from_depth = np.eye(4)
    # By columns.
    color_from_depth[:3, :3] = np.array(extrinsics.rotation).reshape(3, 3).T
    color_from_depth[:3, 3] = extrinsics.translation
    cameras = []
    for kind, profile in (("depth", depth), ("color", color)):
        values = profile.as_video_stream_profile().get_intrinsics()
        coefficients = np.array(values.coeffs, dtype=np.float64)
        if coefficients.any() and values.model.name not in _BROWN:
            raise CalibrationError(
                f"{name}: {kind}: the lens model {values.model.name} is not OpenCV's; give --calibration FILE"
            )
        try:
            cameras.append(
                Intrinsics(
                    values.width, values.height, values.fx, values.fy, values.ppx, values.ppy, coefficients
                )
            )
        except ValueError as err:
            raise CalibrationError(f"{name}: {kind}: {err}; give --calibration FILE") from err
    try:
        return Calibration(cameras[0], cameras[1], color_from_depth)
    except ValueError as err:
        raise CalibrationError(f"{name}: {err}; give --calibration FILE") from err


def _version(text: str) -> tuple[int, ...]:
    parts = text.split(".")
    return tuple(map(int, parts)) if all(part.isdecimal() for part in parts) else ()
