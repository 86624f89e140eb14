"""Output of nurbseg-devices, as text of at most 80 columns or as JSON."""

import json
import textwrap
from collections.abc import Sequence
from dataclasses import asdict

from nurbseg.drivers.doctor.camera_list import Camera
from nurbseg.drivers.doctor.diagnosis import Finding, System, is_ready
from nurbseg.drivers.openni2.stream import VideoMode
from nurbseg.drivers.openni2.usb import SPEED_TEXT

WIDTH = 80
_LABEL_WIDTH = 18
_FORMATS = {"DEPTH_1_MM": "1 mm", "DEPTH_100_UM": "100 um", "RGB888": "RGB"}


def cameras_as_text(cameras: Sequence[Camera]) -> str:
    """Return a table for each camera."""
    if not cameras:
        return "OpenNI2 finds no camera. To find out why: nurbseg-devices doctor"
    count = "1 camera" if len(cameras) == 1 else f"{len(cameras)} cameras"
    version = next((camera.openni2_version for camera in cameras if camera.openni2_version), "")
    blocks = [f"{count}, through OpenNI2 {version}" if version else count]
    for number, camera in enumerate(cameras, start=1):
        port = f"{camera.usb_port}, {SPEED_TEXT[camera.usb_speed]}" if camera.usb_port else "unknown"
        rows = [
            ("status", f"cannot be used: {camera.error}" if camera.error else "ready"),
            ("ids", camera.usb_id),
            ("serial", camera.serial or "unknown"),
            ("USB port", port),
            ("URI" if camera.family == "realsense" else "OpenNI2 URI", camera.uri),
            ("driver", camera.driver_version or "unknown version"),
        ]
        if camera.depth_modes or camera.color_modes:
            rows += [
                ("depth", _modes_as_text(camera.depth_modes)),
                ("color", _modes_as_text(camera.color_modes)),
                ("registration", "in the camera" if camera.registration else "in software only"),
                ("sync", "yes" if camera.sync else "no"),
            ]
        rows += [("note", f"it {doubt}") for doubt in camera.doubts]
        blocks.append("\n".join([f"{number}. {camera.name}", *(_row(label, text) for label, text in rows)]))
    return "\n\n".join(blocks)


def cameras_as_json(cameras: Sequence[Camera]) -> str:
    """Return the cameras as JSON; the keys are those of `Camera`, described in docs/cameras.md."""
    described = [asdict(camera) for camera in cameras]
    for each in described:
        for key in ("depth_modes", "color_modes"):
            each[key] = [mode._asdict() | {"pixel_format": mode.pixel_format.name} for mode in each[key]]
    return json.dumps({"cameras": described}, indent=2)


def findings_as_text(findings: Sequence[Finding], system: System) -> str:
    """Return the doctor's findings with instructions, and what it examined."""
    blocks = []
    for finding in findings:
        mark = "ERROR" if finding.severity == "error" else finding.severity
        lines = _wrapped(finding.title, f"{mark:<9}", 9)
        lines += _wrapped(finding.reason, " " * 9, 9) if finding.reason else []
        # Commands are not wrapped, so that they can be copied.
        lines += [f"{'':9}{number}. {step}" for number, step in enumerate(finding.steps, start=1)]
        blocks.append("\n".join(lines))
    installation = system.installation
    parts = ", ".join(str(part) for part in system.parts) or "no depth camera"
    drivers = ", ".join(name.removeprefix("lib").split(".so")[0] for name in installation.drivers) or "none"
    rows = (
        ("USB", f"{len(system.devices)} devices: {parts}"),
        ("OpenNI2", installation.library or "not found"),
        ("its drivers", f"{drivers} in {installation.drivers_folder}" if installation.library else drivers),
    )
    blocks.append("\n".join(["Looked at", *(_row(label, text) for label, text in rows)]))
    return "\n\n".join([*blocks, f"Result: {'a' if is_ready(findings) else 'no'} camera is ready to use."])


def findings_as_json(findings: Sequence[Finding], system: System) -> str:
    """Return the findings as JSON, described in docs/cameras.md."""
    installation = system.installation
    document = {
        "ready": is_ready(findings),
        "findings": [asdict(finding) for finding in findings],
        "usb_devices": [
            {"ids": part.device.ids, "name": part.model.name, "port": part.device.port}
            for part in system.parts
        ],
        "openni2": {
            "library": installation.library,
            "drivers_folder": installation.drivers_folder,
            "drivers": installation.drivers,
        },
    }
    return json.dumps(document, indent=2)


def _modes_as_text(modes: Sequence[VideoMode]) -> str:
    """Return modes grouped by size and rate: "640x480 at 30, 25 (1 mm, 100 um); ..."."""
    formats: dict[tuple[int, int, int], dict[str, None]] = {}
    for mode in modes:
        name = mode.pixel_format.name
        formats.setdefault((mode.width, mode.height, mode.fps), {})[_FORMATS.get(name, name)] = None
    rates: dict[tuple[int, int, str], list[str]] = {}
    for (width, height, fps), names in formats.items():
        rates.setdefault((width, height, ", ".join(names)), []).append(str(fps))
    texts = [f"{each[0]}x{each[1]} at {', '.join(fps)} ({each[2]})" for each, fps in rates.items()]
    return "; ".join(texts) or "none"


def _row(label: str, text: str) -> str:
    return "\n".join(_wrapped(text, f"   {label:<{_LABEL_WIDTH - 3}}", _LABEL_WIDTH))


def _wrapped(text: str, first: str, indent: int) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    ) or [first]
