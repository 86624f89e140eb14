"""What can go wrong where frames come from."""

from __future__ import annotations


class DriverError(Exception):
    """Base of every error raised by `nurbseg.drivers`."""


class BackendMissingError(DriverError, ImportError):
    """A native library is not installed; the message says which package brings it."""


class DeviceNotFoundError(DriverError):
    """No camera or file matches what was asked for; the only error that permits a fallback."""


class DeviceLostError(DriverError):
    """The camera was unplugged, or failed repeatedly, while it was streaming."""


class FrameTimeoutError(DriverError, TimeoutError):
    """No frame came in time; the source is still usable."""


class EndOfRecordingError(DriverError, EOFError):
    """The normal end of a replay."""


class RecordingFormatError(DriverError, ValueError):
    """A recording is damaged or of an unknown form; the message names the file and the field."""


class CalibrationError(RecordingFormatError):
    """A calibration is missing or holds unusable values; the message names the file and the field."""


class FrameFormatError(RecordingFormatError):
    """One frame of a recording is unusable; the source skips to the next frame at the next read."""
