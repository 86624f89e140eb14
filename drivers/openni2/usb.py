"""What is plugged in: USB devices as the kernel or libusb lists them, and whether this user may open them."""

import errno
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from nurbseg.drivers.openni2.usb_ids import ASUS, Model, identify

Access = Literal["open", "denied", "no-node"]
Speed = Literal["low", "full", "high", "super", "super+", ""]

#: From slowest to fastest, each with its name for a person; unknown counts as fast enough. The place, from 1,
#: is libusb's number of a speed.
SPEED_TEXT: dict[Speed, str] = {
    "low": "1.5 Mbit/s",
    "full": "12 Mbit/s",
    "high": "480 Mbit/s",
    "super": "5 Gbit/s",
    "super+": "10 Gbit/s",
    "": "speed unknown",
}
SPEEDS: tuple[Speed, ...] = tuple(SPEED_TEXT)
#: By the kernel's megabits a second.
_SPEED_BY_MBIT = dict(zip(("1.5", "12", "480", "5000", "10000"), SPEEDS, strict=False)) | {"20000": "super+"}

_HUB_CLASS = 9
#: Time limit of pyusb for each descriptor, milliseconds.
_DESCRIPTOR_LIMIT_MS = 300


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """One USB device; what is not known is empty.

    The `port` is the socket, as the kernel writes it (``"1-2.3"``); unlike the address, it stays the same
    when a device is plugged in again. `drivers` are the kernel drivers that hold its interfaces.
    `usb3_controller` is whether its bus belongs to a USB 3 (xHCI) controller.
    """

    vendor_id: int
    product_id: int
    bus: int = 0
    address: int = 0
    port: str = ""
    speed: Speed = ""
    product: str = ""
    serial: str = ""
    drivers: tuple[str, ...] = ()
    usb3_controller: bool = False

    @property
    def ids(self) -> str:
        """Vendor and product id as lsusb writes them."""
        return f"{self.vendor_id:04x}:{self.product_id:04x}"


class Part(NamedTuple):
    """A USB device that is a depth camera or belongs to one.

    `access` is whether this user can open it: "denied" is no permission, "no-node" that its file under
    /dev/bus/usb is not here.
    """

    device: UsbDevice
    model: Model
    access: Access = "open"

    def __str__(self) -> str:
        return f"{self.model.name} ({self.device.ids}, port {self.device.port or 'unknown'})"


def camera_parts(devices: tuple[UsbDevice, ...], root: Path = Path("/")) -> tuple[Part, ...]:
    """Return the devices that are cameras, or motors and microphones of cameras, each opened for a moment."""
    known = ((each, identify(each.vendor_id, each.product_id, each.product)) for each in devices)
    return tuple(Part(device, model, try_to_open(device, root)) for device, model in known if model)


def read_usb(root: Path = Path("/")) -> tuple[UsbDevice, ...]:
    """Return the devices of the kernel's list, hubs left out; where there is no such list, those of libusb.

    `root` holds ``dev`` and ``sys``.
    """
    folder = root / "sys/bus/usb/devices"
    if not folder.is_dir():
        return _read_libusb()
    devices = []
    # "usb1" is a root hub, "1-2" a device.
    for entry in sorted(folder.glob("[0-9]*")):
        held = {link.resolve().name for link in folder.glob(f"{entry.name}:*/driver") if link.exists()}
        if held == {"hub"}:
            continue
        try:
            device = UsbDevice(
                vendor_id=int(read_text(entry / "idVendor"), 16),
                product_id=int(read_text(entry / "idProduct"), 16),
                bus=int(bus := read_text(entry / "busnum")),
                address=int(read_text(entry / "devnum")),
                port=entry.name,
                speed=_SPEED_BY_MBIT.get(read_text(entry / "speed"), ""),
                product=read_text(entry / "product"),
                serial=read_text(entry / "serial"),
                drivers=tuple(sorted(held)),
                usb3_controller="xhci" in read_text(folder / f"usb{bus}/product").lower(),
            )
        except ValueError:
            continue  # an interface ("1-2:1.0"), or unplugged while it was being read
        devices.append(device)
    return tuple(devices)


def _read_libusb() -> tuple[UsbDevice, ...]:
    """Return the devices that libusb lists, hubs left out; empty if it is missing or cannot list any."""
    import usb.core

    try:
        found = tuple(usb.core.find(find_all=True))
    except (usb.core.NoBackendError, usb.core.USBError):
        return ()
    return tuple(_described(device) for device in found if device.bDeviceClass != _HUB_CLASS)


def _described(device: Any) -> UsbDevice:
    """Describe a device of pyusb; only one that may be a camera is opened, for its product and serial."""
    import usb.core
    import usb.util

    product = serial = ""
    if identify(device.idVendor, device.idProduct) or device.idVendor == ASUS:
        device.default_timeout = _DESCRIPTOR_LIMIT_MS
        # pyusb raises a ValueError if the device has no strings or this user may not open it.
        with suppress(ValueError, usb.core.USBError):
            product = device.product or ""
            serial = device.serial_number or ""
        usb.util.dispose_resources(device)
    ports = ".".join(str(number) for number in device.port_numbers or ())
    return UsbDevice(
        vendor_id=device.idVendor,
        product_id=device.idProduct,
        bus=device.bus or 0,
        address=device.address or 0,
        port=f"{device.bus}-{ports}" if ports else "",
        speed=SPEEDS[device.speed - 1] if device.speed in range(1, len(SPEEDS)) else "",
        product=product,
        serial=serial,
    )


def try_to_open(device: UsbDevice, root: Path = Path("/")) -> Access:
    """Open a device's file and close it again: its mode does not show what a container may not open."""
    node = root / f"dev/bus/usb/{device.bus:03d}/{device.address:03d}"
    try:
        os.close(os.open(node, os.O_RDWR | os.O_CLOEXEC))
    except OSError as err:
        return "denied" if err.errno in (errno.EACCES, errno.EPERM) else "no-node"
    return "open"


def read_text(path: Path) -> str:
    """Return the text of a system file, stripped; empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
