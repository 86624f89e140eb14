"""Where frames come from: cameras, recordings and a synthetic scene."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurbseg.drivers.errors import (
        BackendMissingError,
        CalibrationError,
        DeviceLostError,
        DeviceNotFoundError,
        DriverError,
        EndOfRecordingError,
        FrameFormatError,
        FrameTimeoutError,
        RecordingFormatError,
    )
    from nurbseg.drivers.frame import Calibration, Intrinsics, RGBDFrame
    from nurbseg.drivers.mcap.reader import RecordingReader
    from nurbseg.drivers.mcap.writer import RecordingWriter
    from nurbseg.drivers.options import SourceOptions
    from nurbseg.drivers.registry import open_source
    from nurbseg.drivers.source import FrameSource, Paced

# Imported on use: numpy alone would take most of the time in which a command must show its help.
_MODULES = {
    "errors": (
        "BackendMissingError",
        "CalibrationError",
        "DeviceLostError",
        "DeviceNotFoundError",
        "DriverError",
        "EndOfRecordingError",
        "FrameFormatError",
        "FrameTimeoutError",
        "RecordingFormatError",
    ),
    "frame": ("Calibration", "Intrinsics", "RGBDFrame"),
    "mcap.reader": ("RecordingReader",),
    "mcap.writer": ("RecordingWriter",),
    "options": ("SourceOptions",),
    "registry": ("open_source",),
    "source": ("FrameSource", "Paced"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


__all__ = [
    "BackendMissingError",
    "Calibration",
    "CalibrationError",
    "DeviceLostError",
    "DeviceNotFoundError",
    "DriverError",
    "EndOfRecordingError",
    "FrameFormatError",
    "FrameSource",
    "FrameTimeoutError",
    "Intrinsics",
    "Paced",
    "RGBDFrame",
    "RecordingFormatError",
    "RecordingReader",
    "RecordingWriter",
    "SourceOptions",
    "open_source",
]
