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
    from nurbseg.drivers.registry import SourceOptions, open_source
    from nurbseg.drivers.source import FrameSource, Paced

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
    "SourceOptions",
    "open_source",
]

_MODULES = {
    "Calibration": "frame",
    "Intrinsics": "frame",
    "RGBDFrame": "frame",
    "SourceOptions": "registry",
    "open_source": "registry",
    "FrameSource": "source",
    "Paced": "source",
}


def __getattr__(name: str) -> Any:
    # Late, so that a command's --help need not wait for numpy.
    if name in __all__:
        return getattr(import_module(f"nurbseg.drivers.{_MODULES.get(name, 'errors')}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
