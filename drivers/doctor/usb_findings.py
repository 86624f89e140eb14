"""What can be wrong between a camera and OpenNI2: the bus, permission, power, speed, other programs."""

from collections.abc import Iterator, Sequence

from nurbseg.drivers.doctor.finding import Finding, Part, System
from nurbseg.drivers.doctor.host import Host
from nurbseg.drivers.doctor.usb import SPEED_TEXT, SPEEDS, UsbDevice, UsbScan
from nurbseg.drivers.openni2.usb_ids import Family

RULES_FILE = "/etc/udev/rules.d/60-nurbseg.rules"
BLACKLIST_FILE = "/etc/modprobe.d/nurbseg-kinect.conf"

_PASS_USB_ON = "start it with: docker run -v /dev/bus/usb:/dev/bus/usb --device-cgroup-rule='c 189:* rmw' ..."
_APPLY_RULES = "sudo udevadm control --reload && sudo udevadm trigger"

#: Kernel drivers that leave the depth camera's own interfaces alone.
_HARMLESS_DRIVERS = frozenset({"snd-usb-audio", "hub", "usb", "uvcvideo"})


def udev_rule(device: UsbDevice) -> str:
    """Return the udev rule that lets every user of the computer open a device."""
    return (
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{device.vendor_id:04x}", '
        f'ATTR{{idProduct}}=="{device.product_id:04x}", MODE="0666"'
    )


def bus_findings(system: System, cameras: Sequence[Part]) -> Iterator[Finding]:
    """Report why no USB device can be seen."""
    usb = system.usb
    if not usb.libusb:
        yield Finding(
            "libusb-missing",
            "libusb is not installed",
            "Without it, USB devices cannot be probed.",
            ("sudo apt install libusb-1.0-0",),
            severity="warning" if usb.sysfs else "error",
        )
    if usb.problem:
        yield Finding(
            "usb-scan-failed",
            "USB devices could not be listed",
            f"pyusb says: {usb.problem}",
            severity="warning" if usb.devices else "error",
        )
    if not usb.bus_folder:
        yield _no_bus(system.host, cameras)


def _no_bus(host: Host, cameras: Sequence[Part]) -> Finding:
    title, reason, steps = {
        "container": (
            "This container has no USB",
            "/dev/bus/usb does not exist here, so no camera can be opened. "
            "(With docker's --device /dev/bus/usb, a camera plugged in later is not visible.)",
            (_PASS_USB_ON,),
        ),
        "wsl": (
            "Windows has not passed a USB device to this Linux",
            "/dev/bus/usb does not exist here. WSL gets USB devices through usbipd-win.",
            (
                "in an administrator's PowerShell: winget install usbipd",
                "usbipd list",
                "usbipd bind --busid BUSID",
                "usbipd attach --wsl --busid BUSID",
            ),
        ),
        "computer": (
            "This computer shows no USB bus",
            "/dev/bus/usb does not exist: no USB controller, or its kernel driver is not loaded.",
            ("lspci | grep -i usb", "sudo modprobe -a xhci_pci ehci_pci"),
        ),
    }[host.kind]
    if cameras:
        reason += f" The kernel lists {cameras[0]}, so the camera itself is plugged in."
    return Finding("no-usb-bus", title, reason, steps)


def camera_findings(part: Part, system: System) -> Iterator[Finding]:
    """Report what keeps a camera that is plugged in from being opened or from working well."""
    device, family = part.device, part.model.family
    if SPEEDS.index(device.speed) < SPEEDS.index(family.speed_min):
        usb3 = family.speed_min == "super"
        yield Finding(
            "low-speed",
            f"{part} runs at {SPEED_TEXT[device.speed]} only",
            f"It needs {'USB 3' if usb3 else 'USB 2 at full rate'} ({SPEED_TEXT[family.speed_min]}).",
            (
                "plug it into a USB 3 port (blue inside) of the computer itself"
                if usb3
                else "plug it into a port of the computer itself, without an old hub or a long cable",
            ),
        )
    holders = [driver for driver in device.drivers if driver not in _HARMLESS_DRIVERS]
    if "usbfs" in holders or (device.access == "busy" and not holders):
        yield Finding(
            "in-use",
            f"{part} is in use by another program",
            "Only one program at a time can use a camera.",
            ("close that program; to find it: sudo lsof /dev/bus/usb/*/*",),
        )
    for driver in holders:
        if driver != "usbfs":
            yield Finding(
                "kernel-driver",
                f"The kernel driver {driver} holds {part}",
                "It treats the depth camera as a webcam and keeps OpenNI2's driver out.",
                (
                    f"sudo modprobe -r {driver}",
                    f"permanently: echo 'blacklist {driver}' | sudo tee {BLACKLIST_FILE}",
                ),
            )
    if system.usb.bus_folder:
        yield from _access_findings(part, system.host)
    if device.usb3_controller and family.usb3_trouble:
        folder = system.host.installation.drivers_folder or "OpenNI2/Drivers"
        yield Finding(
            "usb3-port",
            f"{part} is behind a USB 3 controller",
            "Firmware older than 5.8.22 may fail there: 'Failed to set USB interface!', or no frames.",
            (
                "try a USB 2 port, or a USB 2 hub in between",
                f"or put the lines [Device] and UsbInterface=0 into PS1080.ini in {folder}",
                "or update the firmware to 5.8.22 with the vendor's updater",
            ),
            severity="warning",
        )


def _access_findings(part: Part, host: Host) -> Iterator[Finding]:
    device, contained = part.device, host.kind == "container"
    if device.access == "denied":
        yield no_permission(part, host)
    elif device.access == "no-node":
        yield Finding(
            "no-usb-node",
            f"{part} is plugged in, but its device file is not here",
            f"There is no /dev/bus/usb/{device.bus:03d}/{device.address:03d}. "
            + ("It was plugged in after the container was started." if contained else "udev did not add it."),
            (_PASS_USB_ON if contained else "unplug the camera and plug it in again",),
        )
    elif device.access == "silent":
        yield Finding(
            "not-answering",
            f"{part} does not answer",
            "It is on the bus, but a first request to it failed or timed out.",
            ("unplug it, wait five seconds and plug it in again, without a hub in between",),
        )


def no_permission(part: Part, host: Host) -> Finding:
    """Report that this user may not open a device, and how to allow it."""
    rule = f"echo '{udev_rule(part.device)}' | sudo tee -a {RULES_FILE}"
    if host.kind == "container":
        reason = (
            "This container is not allowed to open USB devices, or the host has no udev rule for the camera "
            "(udev runs there, not here)."
        )
        steps: tuple[str, ...] = (_PASS_USB_ON, f"on the host: {rule}", f"on the host: {_APPLY_RULES}")
    elif host.has_rule(part.device.vendor_id, part.device.product_id):
        reason = "A udev rule for it is installed, but has not been applied to it."
        steps = (_APPLY_RULES, "unplug the camera and plug it in again")
    else:
        reason = f"No udev rule names it. The first command adds one to {RULES_FILE}."
        steps = (rule, _APPLY_RULES, "unplug the camera and plug it in again")
    return Finding("no-permission", f"No permission to open {part}", reason, steps)


def power_findings(parts: Sequence[Part]) -> Iterator[Finding]:
    """Report a Kinect whose motor runs from USB while its camera, which needs 12 V, is not there."""
    kinect = [part for part in parts if part.model.family.key == "kinect1"]
    motors = [part for part in kinect if part.model.role == "motor"]
    cameras = [part for part in kinect if part.model.role == "camera"]
    if len(cameras) < len(motors):
        yield Finding(
            "kinect-no-power",
            "A Kinect has no 12 V supply",
            f"Its USB-powered motor is there ({motors[-1].device.ids}), but its camera is not.",
            (
                "connect the Kinect's power adapter (12 V, 1.08 A or more) to the mains",
                "if it is connected: unplug the Kinect from USB and plug it in again",
            ),
        )


def not_plugged_in(usb: UsbScan, others: Sequence[Part], wanted: Sequence[Family]) -> Finding:
    """Report that none of the cameras asked for is there, and which others are."""
    names = " or ".join(family.name for family in wanted)
    if others:
        return Finding(
            "not-plugged-in",
            f"The requested camera is not plugged in, but {others[0]} is",
            f"Requested: {names}.",
            ("use the one that is there: --device any",),
        )
    return Finding(
        "not-plugged-in",
        "No depth camera is plugged in",
        f"Looked through {len(usb.devices)} USB devices for: {names}.",
        (
            "plug the camera into a USB port of this computer",
            "if it is plugged in but lsusb does not list it: try another port and cable",
        ),
    )
