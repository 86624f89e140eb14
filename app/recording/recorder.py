"""The recordings of a run: how they are started, ended and logged."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from nurbseg.app.errors import ExportError
from nurbseg.app.settings.output_config import RecordConfig, dated
from nurbseg.common.errors import DriverError
from nurbseg.common.files import check_absent, part_after
from nurbseg.drivers.source import FrameSource

if TYPE_CHECKING:
    from nurbseg.app.recording.recording import Recording

_log = logging.getLogger(__name__)

#: Name of recordings started by a command, unless another was configured.
DEFAULT_NAME = "recording-{date}.mcap"


class RecordError(ExportError):
    """A recording cannot be started, or is incomplete."""


def open_recording(
    config: RecordConfig,
    source: FrameSource,
    *,
    lossless: bool = False,
) -> Recording | None:
    """Start the configured recording; None if there is none.

    `source` is the camera or recording itself; `lossless` says whether it waits for the recording. Raises
    RecordError if the file exists or cannot be created, or the disk has too little space.
    """
    if config.file is None:
        return None
    from nurbseg.app.recording.recording import Recording
    from nurbseg.drivers.mcap.writer import RecordingWriter

    path = Path(config.file)

    def open_file(part: Path) -> RecordingWriter:
        return RecordingWriter(part, source.calibration, color_format=config.color, metadata=source.metadata)

    try:
        check_absent(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        return Recording(path, open_file, config, lossless=lossless)
    except DriverError as err:
        raise RecordError(str(err)) from err
    except OSError as err:
        raise RecordError(f"{path}: cannot be written: {err.strerror}") from err


def log_recorded(recording: Recording) -> None:
    """Log what was recorded; raises RecordError if the recording failed."""
    if recording.failure:
        raise RecordError(f"{recording.failure}; the {recording.frames} previous frames can be replayed")
    files = ", ".join(str(file) for file in recording.files)
    counted = recording.frames, recording.seconds, recording.size_mb
    _log.info("recorded %d frames, %.1f s, %.1f MB to %s", *counted, files)
    if recording.lost:
        _log.warning("%d frames are missing from %s: writing was too slow", recording.lost, recording.path)
    if recording.frames == 0:
        _log.warning("%s: no frames were recorded, so the file was not kept", recording.path)


class Recorder:
    """Makes the recordings of a run, one after the other.

    The first one starts immediately if `config` names a file; raises RecordError if it cannot. `source`
    and `lossless` are those of `open_recording`. In `name`, that of further files, ``{date}``
    becomes the date and time, and a number is added if the file exists. `recording` is the current one, even
    if it failed. All are closed and logged at the end of a ``with`` block, also if Ctrl-C or an error ends
    it.
    """

    def __init__(
        self,
        config: RecordConfig,
        source: FrameSource,
        *,
        name: str = DEFAULT_NAME,
        lossless: bool = False,
    ) -> None:
        self.recording = open_recording(config, source, lossless=lossless)
        self._config = replace(config, delay_s=0.0)
        self._source = source
        self._name = name
        self._lossless = lossless
        self._ending: list[Recording] = []
        self._figures: list[dict[str, Any]] = []

    @property
    def is_recording(self) -> bool:
        """Whether frames are being recorded."""
        recording = self.recording
        return recording is not None and not recording.ended

    @property
    def has_recorded(self) -> bool:
        """Whether frames are being recorded, or were until the source ended."""
        recording = self.recording
        return recording is not None and not recording.failure

    def begin(self) -> Path:
        """Start a recording while the source is read, and return its file.

        Raises RecordError if there is one already, or the file cannot be created.
        """
        if self.recording is not None and self.is_recording:
            raise RecordError(f"{self.recording.path} is already being recorded")
        path = Path(dated(self._name))
        if path.exists():
            path = part_after(path, 1)
        config = replace(self._config, file=str(path))
        begun = open_recording(config, self._source, lossless=self._lossless)
        self.end()
        self.recording = begun
        return path

    def discard(self) -> None:
        """Close a recording without frames, whose file is not kept: the run cannot start."""
        if self.recording is not None:
            self.recording.close()

    def end(self) -> None:
        """Let go of the current recording, which the capture thread finishes."""
        if self.recording is not None:
            self._ending.append(self.recording)
            self.recording = None

    def log_finished(self) -> None:
        """Log recordings that have ended since; a failed one does not end the run."""
        for each in [each for each in self._ending if each.finished]:
            self._ending.remove(each)
            each.close()
            self._log_ended(each)

    def _log_ended(self, recording: Recording) -> None:
        self._figures.append(recording.figures())
        try:
            log_recorded(recording)
        except RecordError as err:
            _log.error("%s", err)

    def figures(self) -> list[dict[str, Any]]:
        """Return the entries of all recordings in the run's report."""
        rest = self._ending if self.recording is None else [*self._ending, self.recording]
        return [*self._figures, *(each.figures() for each in rest)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        for each in (*self._ending, self.recording):
            if each is not None:
                each.__exit__(*exception)
        if exception[0] is not None:
            # What ends the run is raised, and what is wrong with the recording only logged.
            self.end()
        for each in self._ending:
            self._log_ended(each)
        self._ending.clear()
        if self.recording is not None:
            log_recorded(self.recording)
