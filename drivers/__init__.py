"""Sources of frames: cameras and recordings."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurbseg.common.errors import BackendMissingError as BackendMissingError
    from nurbseg.common.errors import CalibrationError as CalibrationError
    from nurbseg.common.errors import DeviceLostError as DeviceLostError
    from nurbseg.common.errors import DeviceNotFoundError as DeviceNotFoundError
    from nurbseg.common.errors import DriverError as DriverError
    from nurbseg.common.errors import EndOfRecordingError as EndOfRecordingError
    from nurbseg.common.errors import FrameFormatError as FrameFormatError
    from nurbseg.common.errors import FrameTimeoutError as FrameTimeoutError
    from nurbseg.common.errors import RecordingFormatError as RecordingFormatError
    from nurbseg.common.frame import Calibration as Calibration
    from nurbseg.common.frame import Intrinsics as Intrinsics
    from nurbseg.common.frame import RGBDFrame as RGBDFrame
    from nurbseg.drivers.mcap.reader import RecordingReader as RecordingReader
    from nurbseg.drivers.mcap.writer import RecordingWriter as RecordingWriter
    from nurbseg.drivers.options import SourceOptions as SourceOptions
    from nurbseg.drivers.player import Player as Player
    from nurbseg.drivers.registry import open_source as open_source
    from nurbseg.drivers.source import FrameSource as FrameSource

# Imported on use: numpy alone would take most of the time in which a command must show its help.
_NAMES = {
    "common.errors": "BackendMissingError CalibrationError DeviceLostError DeviceNotFoundError DriverError"
    " EndOfRecordingError FrameFormatError FrameTimeoutError RecordingFormatError",
    "common.frame": "Calibration Intrinsics RGBDFrame",
    "drivers.mcap.reader": "RecordingReader",
    "drivers.mcap.writer": "RecordingWriter",
    "drivers.options": "SourceOptions",
    "drivers.player": "Player",
    "drivers.registry": "open_source",
    "drivers.source": "FrameSource",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"nurbseg.{_HOME[name]}"), name)
