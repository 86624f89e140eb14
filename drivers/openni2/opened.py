"""Chooses a camera by kind, URI, serial number or USB port, and opens it with its two streams."""

import contextlib
import ctypes
import logging
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path

from nurbseg.common.closing import Closing, closed_on_error
from nurbseg.common.errors import DeviceNotFoundError, DriverError
from nurbseg.drivers.openni2.capi import DeviceProperty, OniVersion, Sensor, Status
from nurbseg.drivers.openni2.library import DeviceListing, in_use
from nurbseg.drivers.openni2.stream import Stream, WithProperties
from nurbseg.drivers.openni2.usb import read_usb
from nurbseg.drivers.openni2.usb_ids import WANTED, identify

logger = logging.getLogger(__name__)

_DEPTH_TO_COLOR = 1
#: Vendor or name where a driver reports no USB ids, and the family that it stands for.
_WORDS = (
    (re.compile(r"xtion 2", re.IGNORECASE), "xtion2"),
    (re.compile(r"xtion|primesense|ps1080|carmine|asus", re.IGNORECASE), "ps1080"),
    (re.compile(r"kinect.*(v2|2)|freenect2", re.IGNORECASE), "kinect2"),
    (re.compile(r"kinect|freenect", re.IGNORECASE), "kinect1"),
    (re.compile(r"orbbec|astra", re.IGNORECASE), "orbbec"),
)


class OpenedDevice(WithProperties, Closing):
    """A device that is open until `close`, and the library in use for as long.

    `states` are those that it has reported so far, `DeviceState.ERROR` once it is disconnected. Raises
    BackendMissingError if OpenNI2 is not installed, and DeviceNotFoundError if the library cannot open it.
    """

    def __init__(self, uri: str) -> None:
        self.states: set[int] = set()
        self.streams: tuple[Stream, ...] = ()
        self._held = contextlib.ExitStack()
        super().__init__(self._held.enter_context(in_use()), "Device")
        with closed_on_error(self.close):
            # Before it is opened, so that a disconnection in between is not missed.
            self.library.listeners.append((uri, self.states.add))
            self._held.callback(self.library.listeners.remove, (uri, self.states.add))
            native = self.library.native
            self.library.check(
                native.oniDeviceOpen(os.fsencode(uri), ctypes.byref(self.handle)),
                f"opening {uri}",
                DeviceNotFoundError,
            )
        self._held.callback(native.oniDeviceClose, self.handle)

    def has(self, sensor: Sensor) -> bool:
        """Whether the device has a stream of this sensor."""
        return bool(self.library.native.oniDeviceGetSensorInfo(self.handle, sensor))

    def add_stream(self, sensor: Sensor) -> Stream:
        """Make the stream of a sensor; raises DriverError where the device does not give it."""
        stream = Stream(self.library, self.handle, sensor)
        self.streams += (stream,)
        return stream

    @property
    def serial(self) -> str:
        """The serial number; empty where the device reports none."""
        text = self.find(DeviceProperty.SERIAL_NUMBER, ctypes.c_char * 256)
        return "" if text is None else text.value.decode(errors="replace").strip()

    @property
    def driver_version(self) -> str:
        """The version of the device's driver; empty where the device reports none."""
        version = self.find(DeviceProperty.DRIVER_VERSION, OniVersion)
        return "" if version is None else f"{version.major}.{version.minor}.{version.maintenance}"

    @property
    def can_register(self) -> bool:
        """Whether the device reports that it can register depth to color."""
        native = self.library.native
        return bool(native.oniDeviceIsImageRegistrationModeSupported(self.handle, _DEPTH_TO_COLOR))

    def register(self, wanted: bool) -> bool:
        """Ask the device to register depth to color, or not to; return whether it does now."""
        if self.can_register:
            mode = ctypes.c_int(_DEPTH_TO_COLOR if wanted else 0)
            self.set(DeviceProperty.IMAGE_REGISTRATION, mode)
        return bool(self.find(DeviceProperty.IMAGE_REGISTRATION, ctypes.c_int) == _DEPTH_TO_COLOR)

    def synchronize(self) -> bool:
        """Ask the device to take depth and color at the same moment; return whether it does."""
        native = self.library.native
        status = native.oniDeviceEnableDepthColorSync(self.handle)
        return bool(status == Status.OK and native.oniDeviceGetDepthColorSyncEnabled(self.handle))

    def close(self) -> None:
        """Release everything, in the order that the library needs; safe to repeat."""
        for stream in self.streams:
            stream.stop()
        for stream in self.streams:
            stream.destroy()
        self.streams = ()
        self._held.close()


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

    def has_serial(listing: DeviceListing, text: str) -> bool:
        if listing.uri not in serials:
            serials[listing.uri] = serial_of(listing)
        return serials[listing.uri] == text

    if wanted.startswith("port:"):
        matching = [camera for camera in cameras if usb_port(camera.uri) == wanted.removeprefix("port:")]
    elif wanted.lower() in ("", "any"):
        matching = cameras
    elif wanted.lower() in WANTED:
        matching = [camera for camera in cameras if family_of(camera) in WANTED[wanted.lower()]]
    else:
        matching = [camera for camera in cameras if camera.uri == wanted]
        matching = matching or [camera for camera in cameras if has_serial(camera, wanted)]
    if serial:
        matching = [camera for camera in matching if has_serial(camera, serial)]
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


def serial_of(listing: DeviceListing) -> str:
    """Return a listed device's serial number, after opening it; empty where it reports none."""
    try:
        with OpenedDevice(listing.uri) as device:
            return device.serial
    except DriverError as err:
        logger.info("serial number of %s: %s", listing.uri, err)
        return ""


def open_camera(wanted: str, serial: str = "") -> tuple[OpenedDevice, DeviceListing]:
    """Open the requested camera, as `choose` interprets it.

    Of several, the first that opens: another program may have the others. Raises BackendMissingError if
    OpenNI2 is not installed; DeviceNotFoundError if there is no such camera, or none of them can be opened.
    """
    with in_use() as library:
        first: DeviceNotFoundError | None = None
        for listing in choose(library.devices(), wanted, serial, serial_of):
            try:
                return OpenedDevice(listing.uri), listing
            except DeviceNotFoundError as err:
                logger.info("%s", err)
                first = first or err
        raise first or DeviceNotFoundError(f"openni2:{wanted}: no such camera")


def describe(listing: DeviceListing, device: OpenedDevice) -> dict[str, str]:
    """Return what is known of an opened camera, for a person and for recordings."""
    return {
        "device": f"{listing.vendor} {listing.name}".strip(),
        "family": family_of(listing),
        "uri": listing.uri,
        "usb_id": f"{listing.usb_vendor:04x}:{listing.usb_product:04x}",
        "usb_port": usb_port(listing.uri),
        "serial": device.serial,
        "driver_version": device.driver_version,
        "openni2_version": device.library.version(),
    }
