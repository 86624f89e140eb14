"""The RealSense cameras that are connected, each started for a moment, and what may be wrong with them."""

import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from nurbseg.common.errors import BackendMissingError, DriverError
from nurbseg.drivers.doctor.camera_list import Camera
from nurbseg.drivers.doctor.diagnosis import Finding, no_permission
from nurbseg.drivers.openni2.capi import PixelFormat
from nurbseg.drivers.openni2.stream import VideoMode
from nurbseg.drivers.openni2.usb import UsbDevice, try_to_open
from nurbseg.drivers.realsense import sdk
from nurbseg.drivers.realsense.device import RealSenseSource

#: How long a camera may take to send its first image, seconds.
_FIRST_IMAGE_LIMIT_S = 5.0
#: Intel's number, and the first bytes of the numbers of its depth cameras.
_INTEL, _PRODUCTS = 0x8086, (0x0A, 0x0B)
_FORMATS = {"z16": PixelFormat.DEPTH_1_MM, "rgb8": PixelFormat.RGB888}


def list_realsense() -> tuple[Camera, ...]:
    """Ask the SDK for its cameras, and each for an image; none if the SDK is not installed.

    Raises DriverError if the SDK cannot list them.
    """
    try:
        rs = sdk.load()
    except BackendMissingError:
        return ()
    try:
        return tuple(_camera(rs, device) for device in rs.context().query_devices())
    except RuntimeError as err:
        raise DriverError(f"the RealSense SDK could not list its cameras ({err})") from err


def _camera(rs: Any, device: Any) -> Camera:
    listing = sdk.describe(rs, device)
    modes: dict[str, set[VideoMode]] = {"depth": set(), "color": set()}
    for kind, form, mode, *_ in sdk.video_modes(device):
        if form in _FORMATS:
            modes[kind].add(VideoMode(*mode, _FORMATS[form]))
    error = ""
    try:
        with RealSenseSource(listing.serial) as source:
            source.read(_FIRST_IMAGE_LIMIT_S)
    except DriverError as err:
        error = str(err)
    return Camera(
        name=listing.name,
        family="realsense",
        uri=f"realsense:{listing.serial}",
        usb_id=f"{_INTEL:04x}:{listing.product.lower()}",
        usb_port=listing.port,
        usb_speed="high" if listing.usb.startswith("2") else "super",
        serial=listing.serial,
        driver_version=listing.firmware,
        depth_modes=tuple(sorted(modes["depth"])),
        color_modes=tuple(sorted(modes["color"])),
        error=error,
        doubts=listing.doubts,
    )


def realsense_findings(
    devices: Sequence[UsbDevice], *, listed: bool, asked: bool, root: Path = Path("/")
) -> Iterator[Finding]:
    """Report why a RealSense that is plugged in, or `asked` for, is not `listed` by the SDK."""
    plugged = [
        device for device in devices if device.vendor_id == _INTEL and device.product_id >> 8 in _PRODUCTS
    ]
    if not plugged and not asked:
        return
    severity: Any = "error" if asked else "warning"
    if importlib.util.find_spec("pyrealsense2") is None:
        what = plugged[0].product or "a RealSense" if plugged else "a RealSense"
        yield Finding(
            "realsense-sdk-missing",
            "The RealSense SDK is not installed",
            f"Without it, {what} cannot be opened.",
            ("pip install 'nurbseg[realsense]'",),
            severity=severity,
        )
        return
    if listed:
        return
    for device in plugged:
        name = f"{device.product or 'RealSense'} ({device.ids})"
        if try_to_open(device, root) != "open":
            yield no_permission(name, device, severity)
        else:
            yield Finding(
                "not-listed",
                f"{name} is plugged in, but its SDK does not list it",
                steps=("close other programs that use it, unplug it and plug it in again",),
                severity=severity,
            )
    if not plugged:
        yield Finding(
            "not-plugged-in",
            "No RealSense is on the bus",
            "Neither its SDK nor the kernel lists one.",
            ("plug it into a USB 3 port, with a cable for it",),
            severity=severity,
        )
