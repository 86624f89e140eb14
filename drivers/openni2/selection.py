"""Selects a camera: by kind, USB ids, vendor and name, URI, serial number or USB port."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path

from nurbseg.common.errors import DeviceNotFoundError
from nurbseg.drivers.openni2.library import DeviceListing
from nurbseg.drivers.openni2.usb import read_usb
from nurbseg.drivers.openni2.usb_ids import WANTED, identify

#: Vendor or name where a driver reports no USB ids, and the family that it stands for.
_WORDS = (
    (re.compile(r"xtion 2", re.IGNORECASE), "xtion2"),
    (re.compile(r"xtion|primesense|ps1080|carmine|asus", re.IGNORECASE), "ps1080"),
    (re.compile(r"kinect.*(v2|2)|freenect2", re.IGNORECASE), "kinect2"),
    (re.compile(r"kinect|freenect", re.IGNORECASE), "kinect1"),
    (re.compile(r"orbbec|astra", re.IGNORECASE), "orbbec"),
)


def is_camera(listing: DeviceListing) -> bool:
    """Whether this is a camera, and not a recording or the library's dummy."""
    return not listing.uri.lower().endswith(".oni") and listing.uri != "Dummy"


def family_of(listing: DeviceListing) -> str:
    """Return the key of the camera's family, as in `usb_ids.FAMILIES`; empty where it is none of them."""
    words = f"{listing.vendor} {listing.name}"
    model = identify(listing.usb_vendor, listing.usb_product, words)
    if model is not None:
        return model.family.key
    return next((family for pattern, family in _WORDS if pattern.search(words)), "")


def usb_port(uri: str, root: Path = Path("/")) -> str:
    """Return where a camera is plugged in, such as "2-1.3"; the URI itself where that is unknown.

    A camera keeps its port when it is plugged in again, but not its address.
    """
    ports = (device.port for device in read_usb(root) if uri.endswith(f"@{device.bus}/{device.address}"))
    return next(ports, uri)


def choose(
    listings: Iterable[DeviceListing],
    wanted: str,
    serial: str,
    serial_of: Callable[[DeviceListing], str],
) -> list[DeviceListing]:
    """Return the matching cameras, at least one; the caller takes the first that opens.

    `wanted` is "any" or nothing, a kind ("xtion", "kinect", ...: `usb_ids.WANTED`), a URI, a serial number,
    or "port:" and a USB port; `serial`, if not empty, must match too. A camera must be opened for
    `serial_of`. Raises DeviceNotFoundError if there is none; lists those that there are.
    """
    cameras = [listing for listing in listings if is_camera(listing)]
    serials: dict[str, str] = {}

    def known_serial(listing: DeviceListing) -> str:
        if listing.uri not in serials:
            serials[listing.uri] = serial_of(listing)
        return serials[listing.uri]

    if wanted.startswith("port:"):
        matching = [camera for camera in cameras if usb_port(camera.uri) == wanted.removeprefix("port:")]
    elif wanted.lower() in ("", "any"):
        matching = cameras
    elif wanted.lower() in WANTED:
        matching = [camera for camera in cameras if family_of(camera) in WANTED[wanted.lower()]]
    else:
        matching = [camera for camera in cameras if camera.uri == wanted]
        if not matching:
            matching = [camera for camera in cameras if known_serial(camera) == wanted]
    if serial:
        matching = [each for each in matching if known_serial(each) == serial]
    if matching:
        return matching
    name = f"{wanted or 'any'}" + (f" with serial number {serial}" if serial else "")
    there = "; ".join(_described(camera, serials.get(camera.uri)) for camera in cameras)
    raise DeviceNotFoundError(f"openni2:{name}: no such camera; OpenNI2 finds {there or 'no camera at all'}")


def _described(listing: DeviceListing, serial: str | None) -> str:
    ids = f"{listing.usb_vendor:04x}:{listing.usb_product:04x}"
    if serial is not None:  # it was asked for it
        ids += f", serial {serial or 'unknown: it has none, or another program has the camera'}"
    return f"{listing.vendor} {listing.name} ({ids}) at {listing.uri}"
