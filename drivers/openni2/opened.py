"""An opened device: the library in use, the device's handle and properties, and its two streams."""

import contextlib
import ctypes
import logging
import os

from nurbseg.common.closing import Closing, closed_on_error
from nurbseg.common.errors import DeviceNotFoundError, DriverError
from nurbseg.drivers.openni2.capi import DeviceProperty, OniVersion, Sensor, Status
from nurbseg.drivers.openni2.library import DeviceListing, in_use
from nurbseg.drivers.openni2.selection import choose, family_of, usb_port
from nurbseg.drivers.openni2.stream import Stream, WithProperties

logger = logging.getLogger(__name__)

_DEPTH_TO_COLOR = 1


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


def serial_of(listing: DeviceListing) -> str:
    """Return a listed device's serial number, after opening it; empty where it reports none."""
    try:
        with OpenedDevice(listing.uri) as device:
            return device.serial
    except DriverError as err:
        logger.info("serial number of %s: %s", listing.uri, err)
        return ""


def open_camera(wanted: str, serial: str = "") -> tuple[OpenedDevice, DeviceListing]:
    """Open the requested camera, as `nurbseg.drivers.openni2.selection.choose` interprets it.

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
