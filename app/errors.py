"""The errors of what a run makes of its frames."""


class ExportError(Exception):
    """A result cannot be written; the message says where and why."""


class FrameFailedError(RuntimeError):
    """A frame cannot be segmented; the message names it."""


class PublishError(Exception):
    """Results cannot be published; the message names where and why."""
