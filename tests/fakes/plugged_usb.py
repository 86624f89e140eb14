"""A file system with USB devices and an installation of OpenNI2, for tests."""

from dataclasses import dataclass
from pathlib import Path

SPEED_MBIT = {"low": "1.5", "full": "12", "high": "480", "super": "5000", "super+": "10000"}

XTION = (0x1D27, 0x0601)
KINECT_CAMERA = (0x045E, 0x02AE)
KINECT_AUDIO = (0x045E, 0x02AD)
KINECT_MOTOR = (0x045E, 0x02B0)
KINECT_2 = (0x045E, 0x02C4)
ASTRA = (0x2BC5, 0x0401)
MOUSE = (0x046D, 0xC077)


@dataclass
class Plugged:
    """A device as the kernel lists it."""

    ids: tuple[int, int]
    bus: int = 1
    address: int = 5
    ports: tuple[int, ...] = (2,)
    speed: str = "high"
    product: str = ""
    serial: str = ""
    drivers: tuple[str, ...] = ()
    xhci: bool = False


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

    def plug(self, device: Plugged):
        """Give a device its device file and its entries in the kernel's list."""
        self.write(f"dev/bus/usb/{device.bus:03d}/{device.address:03d}", "")
        folder = "sys/bus/usb/devices"
        port = f"{device.bus}-{'.'.join(str(number) for number in device.ports)}"
        hub = "xHCI Host Controller" if device.xhci else "EHCI Host Controller"
        for name, ids, number, product, serial, mbit in (
            (f"usb{device.bus}", (0x1D6B, 2), 1, hub, "0000:00:14.0", "480"),
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
