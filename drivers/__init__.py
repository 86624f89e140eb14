"""Sources of frames: cameras, recordings and a synthetic scene."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurbseg.drivers.errors import BackendMissingError as BackendMissingError
    from nurbseg.drivers.errors import CalibrationError as CalibrationError
    from nurbseg.drivers.errors import DeviceLostError as DeviceLostError
    from nurbseg.drivers.errors import DeviceNotFoundError as DeviceNotFoundError
    from nurbseg.drivers.errors import DriverError as DriverError
    from nurbseg.drivers.errors import EndOfRecordingError as EndOfRecordingError
    from nurbseg.drivers.errors import FrameFormatError as FrameFormatError
    from nurbseg.drivers.errors import FrameTimeoutError as FrameTimeoutError
    from nurbseg.drivers.errors import RecordingFormatError as RecordingFormatError
    from nurbseg.drivers.frame import Calibration as Calibration
    from nurbseg.drivers.frame import Intrinsics as Intrinsics
    from nurbseg.drivers.frame import RGBDFrame as RGBDFrame
    from nurbseg.drivers.live.pacing import Paced as Paced
    from nurbseg.drivers.mcap.reader import RecordingReader as RecordingReader
    from nurbseg.drivers.mcap.writer import RecordingWriter as RecordingWriter
    from nurbseg.drivers.options import SourceOptions as SourceOptions
    from nurbseg.drivers.registry import open_source as open_source
    from nurbseg.drivers.source import FrameSource as FrameSource

# Imported on use: numpy alone would take most of the time in which a command must show its help.
_NAMES = {
    "errors": "BackendMissingError CalibrationError DeviceLostError DeviceNotFoundError DriverError"
    " EndOfRecordingError FrameFormatError FrameTimeoutError RecordingFormatError",
    "frame": "Calibration Intrinsics RGBDFrame",
    "mcap.reader": "RecordingReader",
    "mcap.writer": "RecordingWriter",
    "options": "SourceOptions",
    "registry": "open_source",
    "live.pacing": "Paced",
    "source": "FrameSource",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
