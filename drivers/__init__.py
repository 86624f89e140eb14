"""Where frames come from: cameras, recordings and a synthetic scene."""

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
]
