"""The errors of what a run makes of its frames, and the messages of a command on standard error."""

import logging
import sys

from nurbseg.common.errors import printable


class ExportError(Exception):
    """A result cannot be written; the message says where and why."""


class FrameFailedError(RuntimeError):
    """A frame cannot be segmented; the message names it."""


class PublishError(Exception):
    """Results cannot be published; the message names where and why."""


class ViewError(Exception):
    """Something cannot be shown or saved; the message says what and why."""


def error_text(err: BaseException) -> str:
    """Return an error's message for the user, with its class if the error is not an expected one."""
    expected = isinstance(err, OSError) or type(err).__module__.startswith("nurbseg.")
    return str(err) if expected else f"unexpected failure: {type(err).__name__}: {err}"


class _Format(logging.Formatter):
    """Formats progress as plain lines, and warnings and errors with their level."""

    def __init__(self, command: str) -> None:
        super().__init__()
        self._command = command

    def format(self, record: logging.LogRecord) -> str:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        return printable(f"{self._command}: {level}{super().format(record)}")


def message_handler(command: str, *, repeated: bool = False) -> logging.Handler:
    """Return a handler that writes messages to standard error, repeated ones only if they are `repeated`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Format(command))
    said: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        text = record.getMessage()
        new = text not in said
        said.add(text)
        return new

    if not repeated:
        # A recording is opened once for each frame, or by each process.
        handler.addFilter(is_new)
    return handler
