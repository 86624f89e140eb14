"""The doctor on a bus that umockdev simulates: it reads that bus's files and opens its devices."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

UMOCKDEV = shutil.which("umockdev-run")
pytestmark = pytest.mark.skipif(UMOCKDEV is None, reason="umockdev is missing: sudo apt install umockdev")

#: Of the USB 2.0 specification, chapter 9: descriptors of a device, a configuration and an interface.
_DEVICE, _CONFIGURATION, _INTERFACE = "<BBHBBBBHHHBBBB", "<BBHBBBBB", "<BBBBBBBBB"
_HUB, _VENDOR = 9, 0xFF


@dataclass(frozen=True)
class Plugged:
    """A device on the simulated bus, at a port of its one controller."""

    ids: tuple[int, int]
    product: str
    port: int
    speed: str = "480"
    has_node: bool = True


XTION = Plugged((0x1D27, 0x0601), "PrimeSense Device", 2)
KINECT = Plugged((0x045E, 0x02AE), "Xbox NUI Camera", 3)
KINECT_MOTOR = Plugged((0x045E, 0x02B0), "Xbox NUI Motor", 4)
KINECT_2 = Plugged((0x045E, 0x02C4), "Xbox NUI Sensor", 5, speed="5000")


def described(path: str, each: Plugged, address: int, device_class: int) -> str:
    """Return a device in the format of umockdev."""
    device = struct.pack(_DEVICE, 18, 1, 0x0200, device_class, 0, 0, 64, *each.ids, 0x0100, 1, 2, 0, 1)
    interface = struct.pack(_INTERFACE, 9, 4, 0, 0, 0, device_class or _VENDOR, 0, 0, 0)
    configuration = struct.pack(_CONFIGURATION, 9, 2, 18, 1, 1, 0, 0x80, 250)
    node = f"bus/usb/001/{address:03d}"
    lines = [
        f"P: {path}",
        *([f"N: {node}"] if each.has_node else []),
        *("E: DEVTYPE=usb_device", "E: DRIVER=usb", "E: BUSNUM=001", f"E: DEVNUM={address:03d}"),
        *(f"E: DEVNAME=/dev/{node}", "E: SUBSYSTEM=usb", "A: busnum=1", f"A: devnum={address}"),
        *(f"A: speed={each.speed}", "A: bConfigurationValue=1", f"A: devpath={each.port}"),
        *(f"A: idVendor={each.ids[0]:04x}", f"A: idProduct={each.ids[1]:04x}"),
        *(f"A: bDeviceClass={device_class:02x}", f"A: product={each.product}"),
        f"H: descriptors={(device + configuration + interface).hex()}",
    ]
    return "\n".join([*lines, "", ""])


def diagnosis(
    folder: Path, wanted: str, *plugged: Plugged, controller: str = "EHCI Host Controller"
) -> dict[str, Any]:
    """Return what the doctor says, as JSON, of devices on a simulated bus."""
    bus = "/devices/pci0000:00/0000:00:14.0/usb1"
    text = described(bus, Plugged((0x1D6B, 0x0002), controller, 0), 1, _HUB)
    for address, device in enumerate(plugged, 5):
        text += described(f"{bus}/1-{device.port}", device, address, 0)
    file = folder / "bus.umockdev"
    file.write_text(text)
    doctor = [sys.executable, "-m", "nurbseg.app.devices.devices_command", "doctor", "--json"]
    command = [str(UMOCKDEV), "--device", str(file), "--", *doctor, "--device", wanted]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


#: Findings about the bus; others depend on what is installed.
BUS = {
    *("no-usb-bus", "low-speed", "in-use", "kernel-driver", "usb3-port"),
    *("no-permission", "no-usb-node", "kinect-no-power", "not-plugged-in"),
}


@pytest.mark.parametrize(
    ("wanted", "plugged", "expected", "named"),
    [
        ("xtion", [XTION], set(), ""),
        (
            *("xtion", [replace(XTION, has_node=False)], {"no-usb-node"}),
            "Xtion PRO LIVE (1d27:0601, port 1-2)",
        ),
        ("kinect", [KINECT, KINECT_MOTOR], set(), ""),
        ("kinect", [KINECT_MOTOR], {"kinect-no-power"}, "A Kinect has no 12 V supply"),
        ("kinect", [KINECT_2], set(), ""),
        (
            *("kinect", [replace(KINECT_2, speed="480")], {"low-speed"}),
            "Kinect v2 (045e:02c4, port 1-5) runs at 480 Mbit/s only",
        ),
        ("xtion", [KINECT], {"not-plugged-in"}, "but Kinect v1 (045e:02ae, port 1-3) is"),
        ("any", [], {"not-plugged-in"}, "No depth camera is plugged in"),
    ],
)
def test_it_says_what_is_wrong(
    tmp_path: Path, wanted: str, plugged: list[Plugged], expected: set[str], named: str
) -> None:
    found = diagnosis(tmp_path, wanted, *plugged)
    titles = {each["code"]: each["title"] for each in found["findings"] if each["code"] in BUS}
    assert set(titles) == expected
    assert all(named in title for title in titles.values())
    ids = [(f"{device.ids[0]:04x}:{device.ids[1]:04x}", f"1-{device.port}") for device in plugged]
    assert [(device["ids"], device["port"]) for device in found["usb_devices"]] == ids
    assert not found["ready"]


def test_old_firmware_behind_a_controller_of_usb_3_is_warned_of(tmp_path: Path) -> None:
    found = diagnosis(tmp_path, "xtion", XTION, controller="xHCI Host Controller")
    assert {finding["code"] for finding in found["findings"]} & BUS == {"usb3-port"}
