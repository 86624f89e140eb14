"""USB devices for tests: a backend that pyusb takes for libusb, and a file system that fits it."""

import array
import errno
import os
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import usb.backend
import usb.core

SPEED_NUMBERS = {"low": 1, "full": 2, "high": 3, "super": 4, "super+": 5}
SPEED_MBIT = {"low": "1.5", "full": "12", "high": "480", "super": "5000", "super+": "10000"}

XTION = (0x1D27, 0x0601)
KINECT_CAMERA = (0x045E, 0x02AE)
KINECT_AUDIO = (0x045E, 0x02AD)
KINECT_MOTOR = (0x045E, 0x02B0)
KINECT_2 = (0x045E, 0x02C4)
ASTRA = (0x2BC5, 0x0401)
MOUSE = (0x046D, 0xC077)


@dataclass
class ScriptedDevice:
    """A device; `open_errno` and `transfer_errno` make it refuse."""

    ids: tuple[int, int]
    bus: int = 1
    address: int = 5
    ports: tuple[int, ...] = (2,)
    speed: str = "high"
    product: str = ""
    serial: str = ""
    device_class: int = 0
    open_errno: int = 0
    transfer_errno: int = 0
    transfers: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    drivers: tuple[str, ...] = ()
    xhci: bool = False
    is_open: bool = False


class ScriptedUsb(usb.backend.IBackend):
    """A USB bus with these devices; counts what is left open."""

    def __init__(self, *devices, enumerate_error=None):
        super().__init__()
        self.devices = list(devices)
        self.enumerate_error = enumerate_error

    def enumerate_devices(self):
        if self.enumerate_error is not None:
            raise self.enumerate_error
        return iter(self.devices)

    def get_parent(self, dev):
        return None

    def get_device_descriptor(self, dev):
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0200,
            bDeviceClass=dev.device_class,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=dev.ids[0],
            idProduct=dev.ids[1],
            bcdDevice=0x0100,
            iManufacturer=0,
            iProduct=2 if dev.product else 0,
            iSerialNumber=3 if dev.serial else 0,
            bNumConfigurations=1,
            bus=dev.bus,
            address=dev.address,
            port_number=dev.ports[-1] if dev.ports else None,
            port_numbers=dev.ports,
            speed=SPEED_NUMBERS.get(dev.speed, 0),
        )

    def open_device(self, dev):
        if dev.open_errno:
            raise usb.core.USBError(os.strerror(dev.open_errno), -3, dev.open_errno)
        dev.is_open = True
        return dev

    def close_device(self, dev_handle):
        dev_handle.is_open = False

    def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout):
        dev_handle.transfers.append((bmRequestType, bRequest, wValue, wIndex, timeout))
        if dev_handle.transfer_errno:
            code = dev_handle.transfer_errno
            raise usb.core.USBError(os.strerror(code), -7 if code == errno.ETIMEDOUT else -1, code)
        if not bmRequestType & 0x80:
            return len(data)
        answer = b""
        if bRequest == 0x06:
            answer = self._descriptor(dev_handle, wValue >> 8, wValue & 0xFF)[: len(data)]
        data[: len(answer)] = array.array("B", answer)
        return len(answer)

    @staticmethod
    def _descriptor(device, kind, index):
        if kind == 1:
            return bytes([18, 1, 0, 2, *bytes(14)])
        text = {2: device.product, 3: device.serial}.get(index)
        content = (0x0409).to_bytes(2, "little") if text is None else text.encode("utf-16-le")
        return bytes([len(content) + 2, 3]) + content


class FakeRoot:
    """A file system with the corners that a diagnosis looks at; a whole, working one to begin with."""

    def __init__(self, folder: Path):
        self.path = folder
        self.library = folder / "usr/lib/libOpenNI2.so.0"
        self.drivers = folder / "usr/lib/OpenNI2/Drivers"
        self.ini = folder / "etc/openni2/OpenNI.ini"
        self.drivers.mkdir(parents=True)
        # The words by which Debian's build is told from a vendor's.
        self.library.write_bytes(b"\x7fELF\0.so.0\0/etc/openni2/OpenNI.ini\0")
        for name in ("PS1080", "PSLink", "OniFile"):
            (self.drivers / f"lib{name}.so.0").touch()
        self.write(
            "etc/openni2/OpenNI.ini", '[Device]\n;Override=""\n\n[Drivers]\n;Repository=OpenNI2/Drivers\n'
        )
        self.write("proc/version", "Linux version 6.1.0-18-amd64")
        self.write("proc/1/cgroup", "0::/init.scope\n")
        (folder / "dev/bus/usb").mkdir(parents=True)
        (folder / "sys/bus/usb/devices").mkdir(parents=True)

    def write(self, path, text):
        target = self.path / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)

    def remove(self, path):
        target = self.path / path
        if target.is_dir():
            for child in target.iterdir():
                self.remove(child.relative_to(self.path))
            target.rmdir()
        else:
            target.unlink()

    def plug(self, device: ScriptedDevice):
        """Give a device its device file and its entries in the kernel's list."""
        self.write(f"dev/bus/usb/{device.bus:03d}/{device.address:03d}", "")
        folder = "sys/bus/usb/devices"
        port = f"{device.bus}-{'.'.join(str(number) for number in device.ports)}"
        hub = ("xHCI Host Controller", "xhci-hcd") if device.xhci else ("EHCI Host Controller", "ehci_hcd")
        for name, ids, number, product, serial, mbit in (
            (f"usb{device.bus}", (0x1D6B, 2), 1, hub[0], hub[1], "480"),
            (port, device.ids, device.address, device.product, device.serial, SPEED_MBIT[device.speed]),
        ):
            for key, value in (
                ("idVendor", f"{ids[0]:04x}"),
                ("idProduct", f"{ids[1]:04x}"),
                ("busnum", device.bus),
                ("devnum", number),
                ("product", product),
                ("serial", serial),
                ("speed", mbit),
            ):
                self.write(f"{folder}/{name}/{key}", f"{value}\n")
        for number, driver in enumerate(device.drivers):
            module = self.path / "sys/bus/usb/drivers" / driver
            module.mkdir(parents=True, exist_ok=True)
            interface = self.path / folder / f"{port}:1.{number}"
            interface.mkdir()
            (interface / "driver").symlink_to(module)
