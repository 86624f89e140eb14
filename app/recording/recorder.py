"""Recording while a run goes on: which recorder is taken, and what is said of it at the end."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from nurbseg.app.export.exporter import ExportError
from nurbseg.app.recording.config import RecordConfig
from nurbseg.app.recording.disk_space import free_space, megabytes, shortage
from nurbseg.app.recording.oni import OniRecording
from nurbseg.app.recording.parts import PartedWriter
from nurbseg.app.recording.queue import QueuedRecording
from nurbseg.app.recording.recording import Recording
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.files import check_absent
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.reconnect import Recordable
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)


class RecordError(ExportError):
    """A recording cannot be begun, or is not whole."""


def open_recording(
    config: RecordConfig,
    source: FrameSource,
    *,
    lossless: bool = False,
    free_bytes: Callable[[Path], int] = free_space,
) -> Recording | None:
    """Begin the recording that the configuration asks for; None where it asks for none.

    Parameters
    ----------
    config : RecordConfig
        Where and how.
    source : FrameSource
        The camera or recording itself, without what limits or paces it.
    lossless : bool
        Whether the source waits for the recording.
    free_bytes : callable
        Returns the space that is left where a file is, bytes.

    Raises
    ------
    RecordError
        If the file exists, cannot be made, or the disk has too little space; or if an .oni file is asked
        for, and the source is not a camera.
    """
    if config.file is None:
        return None
    path = Path(config.file)

    def open_file(part: Path) -> RecordingWriter:
        return RecordingWriter(part, source.calibration, color_format=config.color, metadata=source.metadata)

    try:
        check_absent(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        missing = shortage(path, config.space_min_mb, free_bytes)
        if missing:
            raise RecordError(
                f"{path}: {missing}, and recording stops at {config.space_min_mb} MB (--record-space-min)"
            )
        if path.suffix.lower() == ".oni":
            return _open_oni(path, config, source, free_bytes)
        writer = PartedWriter(path, open_file, config.split_s)
    except OSError as err:
        raise RecordError(f"{path}: cannot be written: {err.strerror}") from err
    return QueuedRecording(writer, config, lossless=lossless, free_bytes=free_bytes)


def _open_oni(
    path: Path, config: RecordConfig, source: FrameSource, free_bytes: Callable[[Path], int]
) -> OniRecording:
    if not isinstance(source, Recordable):
        raise RecordError(f"{path}: only cameras record .oni; record this source as .mcap")
    try:
        return OniRecording(path, source, config, free_bytes=free_bytes)
    except DriverError as err:
        raise RecordError(str(err)) from err


def tell_recorded(recording: Recording) -> None:
    """Say in the log what was recorded.

    Raises
    ------
    RecordError
        If the recording ended before the run did.
    """
    if recording.failure:
        raise RecordError(f"{recording.failure}; the {recording.frames} frames before can be replayed")
    files = ", ".join(str(file) for file in recording.files)
    size_mb = megabytes(recording.files)
    _log.info(
        "recorded %d frames, %.1f s, %.1f MB to %s", recording.frames, recording.seconds, size_mb, files
    )
    if recording.lost:
        _log.warning("%d frames are missing in %s: writing was too slow", recording.lost, recording.path)
    if recording.frames == 0:
        _log.warning("%s: no frame came to be recorded, and the file was not kept", recording.path)
