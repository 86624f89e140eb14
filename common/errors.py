"""The errors of frame sources."""

import reprlib
from collections.abc import Iterable


class DriverError(Exception):
    """Base of every error raised by `nurbseg.drivers`."""


class BackendMissingError(DriverError, ImportError):
    """A native library is not installed; the message says which package provides it."""


class DeviceNotFoundError(DriverError):
    """No camera or file matches the request; the only error that permits a fallback."""


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
    """One frame is unusable; the source skips to the next frame at the next read."""


#: Characters that are quoted of a value or name, and names that are listed.
_QUOTED_CHARACTERS, _LISTED = 80, 20


_short = reprlib.Repr()
_short.maxlevel, _short.maxstring, _short.maxother = 3, _QUOTED_CHARACTERS, _QUOTED_CHARACTERS


def in_utf8(text: str) -> str:
    """Return a text as UTF-8 can hold it: the names of files may have bytes that are not."""
    return text.encode("utf-8", "backslashreplace").decode()


def printable(text: str) -> str:
    """Return a message without anything but text and line ends, such as the escape codes of a terminal."""
    return "".join(each if each.isprintable() or each == "\n" else repr(each)[1:-1] for each in text)


def named(name: str) -> str:
    """Return a name that a file gives, of a topic or member, as messages show it: see `quoted`."""
    return quoted(name)[1:-1] if len(name) > _QUOTED_CHARACTERS else printable(name)


def listed(names: Iterable[str]) -> str:
    """Return names as messages list them: the first twenty, and how many there are more."""
    every = list(names)
    rest = [f"and {len(every) - _LISTED} more"] * (len(every) > _LISTED)
    return ", ".join([*every[:_LISTED], *rest])


def quoted(value: object) -> str:
    """Return a value of a file as an error quotes it: 80 characters at most, however large it is."""
    try:
        text = _short.repr(value)
    except ValueError:  # Python does not print as many
        text = "an integer of thousands of digits"
    return text if len(text) <= _QUOTED_CHARACTERS else f"{text[: _QUOTED_CHARACTERS - 3]}..."
