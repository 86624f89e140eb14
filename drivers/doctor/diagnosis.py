"""The diagnosis: why a depth camera does not work, and what to do about it.

`diagnose` is a pure function of a described system; `describe` describes this computer.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from nurbseg.drivers.doctor.installation import Installation, find_installation
from nurbseg.drivers.openni2.library import LIBRARY_FILE, REDIST_VARIABLE
from nurbseg.drivers.openni2.usb import SPEED_TEXT, SPEEDS, Part, UsbDevice, camera_parts, read_usb
from nurbseg.drivers.openni2.usb_ids import families

Severity = Literal["ok", "error", "warning"]
_ORDER = ("ok", "error", "warning")

_RULES_FILE = "/etc/udev/rules.d/60-nurbseg.rules"
_CONTAINER = (
    "in a container: docker run -v /dev/bus/usb:/dev/bus/usb --device-cgroup-rule='c 189:* rmw' ..., "
    "with udev rules on the host"
)
#: Kernel drivers that leave the depth camera's own interfaces alone.
_HARMLESS_DRIVERS = frozenset({"snd-usb-audio", "usb", "uvcvideo"})


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding: what it is, how that is known and why it matters, and what to do.

    The `code` is for programs; docs/cameras.md lists all. An error keeps a camera from working, a warning may
    do so. A step is one command or action.
    """

    code: str
    severity: Severity = field(default="error", kw_only=True)
    title: str
    reason: str = ""
    steps: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Probe:
    """The cameras that OpenNI2, or the SDK of RealSense, itself lists.

    It opened the `cameras`, and gave a reason for each that it `refused`; `error` is why it could not list
    any. `doubts` are what may keep one from working well.
    """

    cameras: tuple[str, ...] = ()
    refused: tuple[tuple[str, str], ...] = ()
    error: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class System:
    """A computer as far as depth cameras are concerned.

    Of the USB `devices`, `parts` are cameras or belong to one. `bus_folder` is whether /dev/bus/usb is there;
    `probe` is None where OpenNI2 was not asked.
    """

    devices: tuple[UsbDevice, ...]
    parts: tuple[Part, ...]
    bus_folder: bool
    installation: Installation
    probe: Probe | None = None


def describe(
    root: Path = Path("/"), environ: Mapping[str, str] = os.environ, probe: Probe | None = None
) -> System:
    """Describe this computer, as its files and OpenNI2 itself (`probe`) show it."""
    devices, bus_folder = read_usb(root), (root / "dev/bus/usb").is_dir()
    return System(devices, camera_parts(devices, root), bus_folder, find_installation(root, environ), probe)


def diagnose(system: System, wanted: str = "any") -> tuple[Finding, ...]:
    """Find out why no camera can be used, or that one can.

    `wanted` is what `--device` was given: ``"xtion"``, ``"kinect"``, ``"orbbec"``, or anything else for any
    camera. Returns good news first, then errors and warnings; within each, the most basic first. Where a
    camera is ready, what keeps another from working is a warning only.
    """
    found = list(_findings(system, wanted))
    if system.probe is not None:
        found += probe_findings(system.probe, found)
    if is_ready(found):
        found = [replace(each, severity="warning") if each.severity == "error" else each for each in found]
    return tuple(sorted(found, key=lambda each: _ORDER.index(each.severity)))


def is_ready(findings: Sequence[Finding]) -> bool:
    """Whether a camera can be used."""
    return any(finding.severity == "ok" for finding in findings)


def explain_no_camera(wanted: str = "any") -> str:
    """Return in a few lines why the camera asked for is not there and what to do; never raises.

    Looks at USB and the file system only, which takes some tens of milliseconds.
    """
    try:
        errors = [each for each in diagnose(describe(), wanted) if each.severity == "error"]
    except Exception as err:
        # This is part of the report of another error, which it must not hide.
        return f"To find out why: nurbseg-devices doctor   (it failed here: {type(err).__name__}: {err})"
    if not errors:
        return "USB and OpenNI2's files look as they should. To find out why: nurbseg-devices doctor"
    main = errors[0]
    lines = [f"{main.title}. {main.reason}".strip(), *(f"  {step}" for step in main.steps)]
    return "\n".join([*lines, "To see everything that was found: nurbseg-devices doctor"])


def _findings(system: System, wanted: str) -> Iterator[Finding]:
    kinds = families(wanted)
    parts = [part for part in system.parts if part.model.family in kinds]
    cameras = [part for part in parts if part.model.role == "camera"]
    yield from _library_findings(system.installation)
    if not system.bus_folder:
        yield Finding(
            "no-usb-bus",
            "There is no USB bus here",
            "/dev/bus/usb does not exist" + (f", though the kernel lists {cameras[0]}." if cameras else "."),
            (
                _CONTAINER,
                "in WSL, from an administrator's PowerShell: usbipd bind --busid BUSID; "
                "usbipd attach --wsl --busid BUSID",
                "in a virtual machine: have its settings pass the camera on",
            ),
        )
    for camera in cameras:
        yield from _camera_findings(camera, system)
        yield from _driver_findings(camera, system.installation)
    roles = [part.model.role for part in parts if part.model.family.key == "kinect1"]
    unpowered = roles.count("camera") < roles.count("motor")
    if unpowered:
        yield Finding(
            "kinect-no-power",
            "A Kinect has no 12 V supply",
            "Its motor, which USB supplies, is there, but its camera is not.",
            (
                "connect the Kinect's power adapter (12 V, 1.08 A or more) to the mains",
                "if it is connected: unplug the Kinect from USB and plug it in again",
            ),
        )
    if cameras or unpowered or not system.bus_folder:
        return
    names = " or ".join(family.name for family in kinds)
    other = next((part for part in system.parts if part.model.role == "camera"), None)
    if other:
        yield Finding(
            "not-plugged-in",
            f"The requested camera is not plugged in, but {other} is",
            f"Requested: {names}.",
            ("use the one that is there: --device any",),
        )
    else:
        yield Finding(
            "not-plugged-in",
            "No depth camera is plugged in",
            f"Looked through {len(system.devices)} USB devices for: {names}.",
            (
                "plug the camera into a USB port of this computer",
                "if it is plugged in but lsusb does not list it: try another port and cable",
            ),
        )


def _camera_findings(part: Part, system: System) -> Iterator[Finding]:
    """Report what keeps a camera that is plugged in from being opened or from working well."""
    device, family = part.device, part.model.family
    if SPEEDS.index(device.speed) < SPEEDS.index(family.speed_min):
        yield Finding(
            "low-speed",
            f"{part} runs at {SPEED_TEXT[device.speed]} only",
            f"It needs {SPEED_TEXT[family.speed_min]}.",
            (
                "plug it into a USB 3 port (blue inside) of the computer itself"
                if family.speed_min == "super"
                else "plug it into a port of the computer itself, without an old hub or a long cable",
            ),
        )
    for driver in device.drivers:
        if driver == "usbfs":
            yield Finding(
                "in-use",
                f"{part} is in use by another program",
                "Only one program at a time can use a camera.",
                ("close that program; to find it: sudo lsof /dev/bus/usb/*/*",),
            )
        elif driver not in _HARMLESS_DRIVERS:
            yield Finding(
                "kernel-driver",
                f"The kernel driver {driver} holds {part}",
                "It treats the depth camera as a webcam and keeps OpenNI2's driver out.",
                (
                    f"sudo modprobe -r {driver}",
                    f"permanently: echo 'blacklist {driver}' | sudo tee /etc/modprobe.d/nurbseg-kinect.conf",
                ),
            )
    if part.access == "denied":
        yield no_permission(str(part), device)
    elif part.access == "no-node" and system.bus_folder:
        yield Finding(
            "no-usb-node",
            f"{part} is plugged in, but its device file is not here",
            f"/dev/bus/usb/{device.bus:03d}/{device.address:03d} cannot be opened.",
            ("unplug the camera and plug it in again", _CONTAINER),
        )
    if device.usb3_controller and family.usb3_trouble:
        yield Finding(
            "usb3-port",
            f"{part} is behind a USB 3 controller",
            "Firmware older than 5.8.22 may fail there: 'Failed to set USB interface!', or no frames.",
            (
                "try a USB 2 port, or a USB 2 hub in between",
                "or put the lines [Device] and UsbInterface=0 into PS1080.ini in "
                f"{system.installation.drivers_folder or 'OpenNI2/Drivers'}",
                "or update the firmware to 5.8.22 with the vendor's updater",
            ),
            severity="warning",
        )


def no_permission(name: str, device: UsbDevice, severity: Severity = "error") -> Finding:
    """Report that this user may not open a device, and how to allow it."""
    rule = (
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{device.vendor_id:04x}", '
        f'ATTR{{idProduct}}=="{device.product_id:04x}", MODE="0666"'
    )
    return Finding(
        "no-permission",
        f"No permission to open {name}",
        f"This user may not write its device file. The first command adds a udev rule to {_RULES_FILE}.",
        (
            f"echo '{rule}' | sudo tee -a {_RULES_FILE}",
            "sudo udevadm control --reload && sudo udevadm trigger",
            "unplug the camera and plug it in again",
            _CONTAINER,
        ),
        severity=severity,
    )


def _library_findings(installation: Installation) -> Iterator[Finding]:
    """Report what is wrong with OpenNI2's library and its settings file."""
    redist, ini = installation.redist, installation.ini
    if not installation.library:
        yield Finding(
            "library-missing",
            f"{REDIST_VARIABLE} names a folder without OpenNI2"
            if redist
            else "The OpenNI2 library is not installed",
            f"There is no {LIBRARY_FILE} in {redist or 'the folders of libraries'}.",
            (
                f"unset {REDIST_VARIABLE}   (uses the system's library)"
                if redist
                else "sudo apt install libopenni2-0   (Debian and Ubuntu)",
                f"or, for a vendor's SDK: ln -s libOpenNI2.so {LIBRARY_FILE} in its folder, "
                f"and export {REDIST_VARIABLE}=FOLDER",
            ),
        )
    if installation.repository:
        yield Finding(
            "drivers-folder-overridden",
            f"{ini} sends OpenNI2 to another drivers folder",
            f"Repository={installation.repository}: drivers are loaded from there and nowhere else.",
            (f"sudo nano {ini}   (a ; before the line restores the default folder)",),
            severity="warning",
        )
    if installation.override:
        yield Finding(
            "ini-override",
            f"{ini} makes OpenNI2 open one device only",
            f"Override={installation.override} under [Device] replaces whichever camera is requested.",
            (f"sudo nano {ini}   (put a ; before the line)",),
        )


def _driver_findings(part: Part, installation: Installation) -> Iterator[Finding]:
    """Report whether OpenNI2 has the driver of a camera that is plugged in."""
    family, folder, suffix = part.model.family, installation.drivers_folder, installation.suffix
    if not folder or any(name.lower().startswith(family.file_stem) for name in installation.drivers):
        return
    where = f"Debian's {family.package} provides it" if family.package else "Debian does not package it"
    yield Finding(
        "driver-missing",
        f"The driver of {part} is not installed",
        f"OpenNI2 needs the driver {family.driver} in {folder}, in a file that ends in {suffix}. {where}.",
        tuple(step.format(drivers=folder, suffix=suffix) for step in family.install),
    )


def probe_findings(probe: Probe, found: Sequence[Finding]) -> Iterator[Finding]:
    """Report what OpenNI2 returned when its cameras were listed.

    An error among what was found without asking explains an empty or failed answer.
    """
    for name in probe.cameras:
        yield Finding("ready", f"Ready: {name}", "It can be opened, and images arrive.", severity="ok")
    for doubt in probe.doubts:
        yield Finding("doubt", doubt, severity="warning")
    for name, words in probe.refused:
        yield Finding(
            "not-opened",
            f"OpenNI2 lists {name}, but it cannot be used",
            words,
            (
                "close other programs that use it, unplug it and plug it in again",
                "or try a USB 2 port, or a USB 2 hub in between (docs/cameras.md, USB 3)",
            ),
        )
    if any(each.severity == "error" for each in found) or probe.cameras or probe.refused:
        return
    if probe.error:
        yield Finding("openni2-failed", "OpenNI2 could not be queried for cameras", probe.error)
    else:
        yield Finding(
            "not-listed",
            "A camera is plugged in, but OpenNI2 does not list it",
            "Its driver is installed, but did not accept it.",
            ("unplug the camera, wait five seconds and plug it in again",),
        )
