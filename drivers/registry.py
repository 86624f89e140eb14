"""Opens a source of frames from what a user names: a URI or a path."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.drivers.opening import open_here
from nurbseg.drivers.options import SourceOptions

if TYPE_CHECKING:
    from nurbseg.drivers.source import FrameSource


def open_source(uri: str | Path, options: SourceOptions | None = None) -> FrameSource:
    """Open a camera or a recording.

    A camera, and a source of another package, is read by a process of its own,
    `nurbseg.drivers.process.client.SourceProcess`: it may crash or hang.

    Parameters
    ----------
    uri : str or Path
        ``openni2:`` or ``realsense:`` with what these understand, ``images:?color=GLOB&depth=GLOB``, the
        path of a file or folder, which is recognized by its content, or else a scheme of another package
        (`nurbseg.drivers.plugins`).
    options : SourceOptions, optional
        What the recording does not say itself.

    Returns
    -------
    FrameSource
        Open; to be closed by the caller.

    Raises
    ------
    DeviceNotFoundError
        If the path does not exist or no such camera is connected.
    RecordingFormatError
        If the file or folder is of no known form, damaged, or cannot be read.
    CalibrationError
        If a recording brings no calibration and `options` give none.
    BackendMissingError
        If a library that the source needs is not installed.
    TypeError
        If `uri` is neither.
    """
    options = options or SourceOptions()

    def apart(*_: object) -> FrameSource:
        from nurbseg.drivers.process.client import SourceProcess

        return SourceProcess(str(uri), options)

    return open_here(uri, options, apart)
