"""The values of a diagnosis: the findings, and the system that was examined."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from nurbseg.drivers.doctor.host import Host
from nurbseg.drivers.doctor.usb import UsbDevice, UsbScan
from nurbseg.drivers.openni2.usb_ids import Model

Severity = Literal["error", "warning", "note", "ok"]


class Part(NamedTuple):
    """A USB device that is a depth camera or belongs to one."""

    device: UsbDevice
    model: Model

    def __str__(self) -> str:
        port = f", port {self.device.port}" if self.device.port else ""
        return f"{self.model.name} ({self.device.ids}{port})"


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

    `probe` is None where OpenNI2 was not asked; `uncached` says why compiled code is not kept, if it is not.
    """

    usb: UsbScan
    host: Host
    probe: Probe | None = None
    uncached: str = ""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The USB devices that are cameras, or motors and microphones of cameras."""
        known = ((device, device.model) for device in self.usb.devices)
        return tuple(Part(device, model) for device, model in known if model is not None)
