"""What is plugged in: USB devices as the kernel lists them and as pyusb can open them.

The kernel's list (sysfs) gives names, serial numbers, speeds and kernel drivers without permission and
without USB traffic; pyusb shows whether this user may open a device. Either may be absent, as in a container
or where libusb is not installed, and the other is then used alone.
"""

import errno
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from nurbseg.common.errors import BackendMissingError
from nurbseg.drivers.openni2.usb_ids import ASUS, Model, identify

Access = Literal["open", "denied", "busy", "no-node", "silent", "unknown"]
Speed = Literal["low", "full", "high", "super", "super+", ""]

#: From slowest to fastest, each with its name for a person; unknown counts as fast enough. Its place, from 1,
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
#: sysfs' megabits a second.
_MBIT = ("1.5", "12", "480", "5000", "10000")
_SPEED_BY_MBIT: dict[str, Speed] = dict(zip(_MBIT, SPEEDS, strict=False)) | {"20000": "super+"}

_ACCESS_BY_ERRNO: dict[int | None, Access] = {
    errno.EACCES: "denied",
    errno.EPERM: "denied",
    errno.EBUSY: "busy",
    errno.ENOENT: "no-node",
    errno.ENODEV: "no-node",
    errno.ETIMEDOUT: "silent",
    errno.EPIPE: "silent",
    errno.EIO: "silent",
}

_HUB_CLASS = 9
_GET_DESCRIPTOR = 0x06
_DEVICE_DESCRIPTOR = 0x0100
_DEVICE_DESCRIPTOR_LENGTH = 18
_TRANSFER_TIMEOUT_MS = 300


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """One USB device; what is not known is empty.

    The `port` is the socket, as the kernel writes it (``"1-2.3"``); unlike the address, it stays the same
    when a device is plugged in again. `drivers` are the kernel drivers that hold its interfaces.
    `usb3_controller` is whether its bus belongs to a USB 3 (xHCI) controller. `access` is whether this user
    can open it: "denied" is no permission, "no-node" that its file under /dev/bus/usb is not here, "silent"
    that it does not answer, "unknown" that it was not tried.
    """

    vendor_id: int
    product_id: int
    bus: int = 0
    address: int = 0
    port: str = ""
    speed: Speed = ""
    product: str = ""
    serial: str = ""
    access: Access = "unknown"
    drivers: tuple[str, ...] = ()
    usb3_controller: bool = False

    @property
    def ids(self) -> str:
        """Vendor and product id as lsusb writes them."""
        return f"{self.vendor_id:04x}:{self.product_id:04x}"

    @property
    def model(self) -> Model | None:
        """Which camera, or part of one, it is; None where it is neither."""
        return identify(self.vendor_id, self.product_id, self.product)


@dataclass(frozen=True, slots=True)
class UsbScan:
    """What was found on the USB buses: devices by bus and address.

    `libusb` is whether pyusb found a libusb to work with, `bus_folder` and `sysfs` whether /dev/bus/usb and
    the kernel's list are there, and `problem` what went wrong while scanning.
    """

    devices: tuple[UsbDevice, ...] = ()
    libusb: bool = True
    bus_folder: bool = True
    sysfs: bool = True
    problem: str = ""


def scan_usb(
    backend: Any = None,
    root: Path = Path("/"),
    *,
    budget_s: float = 2.0,
    clock: Callable[[], float] = time.monotonic,
) -> UsbScan:
    """List the USB devices and try to open those that belong to depth cameras.

    After `budget_s` no further device is tried; each try has a time limit of its own. `root` holds ``dev``
    and ``sys``; `backend` is what pyusb works through, libusb by default.
    """
    listed = {(device.bus, device.address): device for device in read_sysfs(root)}
    libusb, problem = True, ""
    deadline_s = clock() + budget_s
    try:
        for each in find_devices(backend):
            if each.bDeviceClass == _HUB_CLASS:
                continue
            place = each.bus or 0, each.address or 0
            device = listed.get(place) or _described(each)
            may_be_camera = device.model is not None or (device.vendor_id == ASUS and not device.product)
            listed[place] = _probed(each, device) if may_be_camera and clock() < deadline_s else device
    except BackendMissingError:
        libusb = False
    except Exception as err:
        # A scan is a report on an unknown system: whatever pyusb raises is part of what it reports.
        problem = f"{type(err).__name__}: {err}"
    return UsbScan(
        devices=tuple(_with_node_access(listed[key], root) for key in sorted(listed)),
        libusb=libusb,
        bus_folder=(root / "dev/bus/usb").is_dir(),
        sysfs=(root / "sys/bus/usb/devices").is_dir(),
        problem=problem,
    )


def read_sysfs(root: Path = Path("/")) -> tuple[UsbDevice, ...]:
    """Return the devices of the kernel's list, hubs left out; empty where there is none."""
    folder = root / "sys/bus/usb/devices"
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return ()
    devices = []
    for entry in entries:
        # "usb1" is a root hub, "1-2" a device and "1-2:1.0" an interface of it.
        if ":" in entry.name or not entry.name[0].isdigit():
            continue
        try:
            device = UsbDevice(
                vendor_id=int(_line(entry / "idVendor"), 16),
                product_id=int(_line(entry / "idProduct"), 16),
                bus=int(_line(entry / "busnum")),
                address=int(_line(entry / "devnum")),
                port=entry.name,
                speed=_SPEED_BY_MBIT.get(_line(entry / "speed"), ""),
                product=_line(entry / "product"),
                serial=_line(entry / "serial"),
            )
        except ValueError:
            continue  # unplugged while it was being read
        interfaces = [each for each in entries if each.name.startswith(entry.name + ":")]
        held = {
            Path(os.path.realpath(interface / "driver")).name
            for interface in interfaces
            if (interface / "driver").exists()
        }
        root_hub = folder / f"usb{device.bus}"
        controller = f"{_line(root_hub / 'product')} {_line(root_hub / 'manufacturer')}".lower()
        if held != {"hub"}:
            devices.append(replace(device, drivers=tuple(sorted(held)), usb3_controller="xhci" in controller))
    return tuple(devices)


def find_devices(backend: Any = None) -> list[Any]:
    """Return pyusb's devices; raises BackendMissingError if pyusb finds no libusb."""
    import usb.core

    try:
        return list(usb.core.find(find_all=True, backend=backend) or ())
    except usb.core.NoBackendError as err:
        raise BackendMissingError("libusb-1.0 was not found: sudo apt install libusb-1.0-0") from err


def _described(each: Any) -> UsbDevice:
    """Return what pyusb knows of a device without asking it."""
    numbers = ".".join(str(number) for number in each.port_numbers or ())
    return UsbDevice(
        vendor_id=each.idVendor,
        product_id=each.idProduct,
        bus=each.bus or 0,
        address=each.address or 0,
        port=f"{each.bus}-{numbers}" if numbers else "",
        speed=SPEEDS[each.speed - 1] if each.speed in range(1, len(SPEEDS)) else "",
    )


def _probed(each: Any, device: UsbDevice) -> UsbDevice:
    """Open a device, ask for its descriptor and its names, and close it again."""
    import usb.core
    import usb.util

    each.default_timeout = _TRANSFER_TIMEOUT_MS
    try:
        each.ctrl_transfer(0x80, _GET_DESCRIPTOR, _DEVICE_DESCRIPTOR, 0, _DEVICE_DESCRIPTOR_LENGTH)
        device = replace(device, access="open")
        return replace(
            device,
            product=device.product or _text(each, each.iProduct),
            serial=device.serial or _text(each, each.iSerialNumber),
        )
    except usb.core.USBError as err:
        if device.access == "open":
            return device  # only its names could not be read
        return replace(device, access=_ACCESS_BY_ERRNO.get(err.errno, "silent"))
    finally:
        usb.util.dispose_resources(each)


def _text(each: Any, index: int) -> str:
    import usb.util

    try:
        return str(usb.util.get_string(each, index) or "").strip() if index else ""
    except ValueError:
        return ""  # pyusb's "no langid": the device has no readable strings


def _with_node_access(device: UsbDevice, root: Path) -> UsbDevice:
    """Judge by its file whether a camera can be opened, where pyusb did not try."""
    if device.access != "unknown" or device.model is None:
        return device
    node = root / f"dev/bus/usb/{device.bus:03d}/{device.address:03d}"
    if not node.exists():
        return replace(device, access="no-node")
    return device if os.access(node, os.R_OK | os.W_OK) else replace(device, access="denied")


def read_text(path: Path) -> str:
    """Return the text of a system file; empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _line(path: Path) -> str:
    return read_text(path).strip()
