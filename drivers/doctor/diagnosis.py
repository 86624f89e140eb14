"""The diagnosis: why a depth camera does not work, and what to do about it.

`diagnose` is a pure function of a described system; `describe` describes this computer.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nurbseg.common.code_cache import CACHE_ADVICE, cache_error
from nurbseg.drivers.doctor import openni2_findings, usb_findings
from nurbseg.drivers.doctor.finding import Finding, Probe, System
from nurbseg.drivers.doctor.host import read_host
from nurbseg.drivers.doctor.usb import scan_usb
from nurbseg.drivers.openni2.usb_ids import families

_ORDER = ("ok", "error", "warning", "note")


def describe(
    *,
    backend: Any = None,
    root: Path = Path("/"),
    environ: Mapping[str, str] | None = None,
    probe: Probe | None = None,
) -> System:
    """Describe this computer, as `scan_usb` and `read_host` find it and as OpenNI2 itself did (`probe`)."""
    environ = os.environ if environ is None else environ
    return System(scan_usb(backend, root), read_host(root, environ), probe, cache_error())


def diagnose(system: System, wanted: str = "any") -> tuple[Finding, ...]:
    """Find out why no camera can be used, or that one can.

    `wanted` is what `--device` was given: ``"xtion"``, ``"kinect"``, ``"orbbec"``, or anything else for any
    camera. Returns good news first, then errors, warnings and notes; within each, the most basic first. Where
    a camera is ready, what keeps another from working is a warning only.
    """
    found = list(_findings(system, wanted))
    if system.probe is not None:
        found += openni2_findings.probe_findings(system.probe, found)
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
    usb, installation, kinds = system.usb, system.host.installation, families(wanted)
    parts = [part for part in system.parts if part.model.family in kinds]
    cameras = [part for part in parts if part.model.role == "camera"]
    yield from openni2_findings.library_findings(installation)
    yield from usb_findings.bus_findings(system, cameras)
    for camera in cameras:
        yield from usb_findings.camera_findings(camera, system)
        yield from openni2_findings.driver_findings(camera, installation)
    unpowered = list(usb_findings.power_findings(parts))
    yield from unpowered
    if not cameras and not unpowered and usb.bus_folder and (usb.libusb or usb.sysfs) and not usb.problem:
        others = [part for part in system.parts if part.model.role == "camera"]
        yield usb_findings.not_plugged_in(usb, others, kinds)
    if system.uncached:
        yield Finding(
            "code-not-kept",
            "Compiled loops cannot be kept: every run compiles them anew",
            f"The first frame comes some ten seconds late. {system.uncached}",
            (CACHE_ADVICE,),
            severity="warning",
        )
