"""The recordings of a run, which the source process writes: how they are started, ended and logged."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from nurbseg.app.errors import ExportError
from nurbseg.app.settings.output_config import RecordConfig, dated
from nurbseg.common.errors import DriverError
from nurbseg.common.files import part_after
from nurbseg.drivers.process.messages import Recorded, RecordOptions

if TYPE_CHECKING:
    from nurbseg.drivers.process.client import SourceProcess

_log = logging.getLogger(__name__)

#: Name of recordings started by a command, unless another was configured.
DEFAULT_NAME = "recording-{date}.mcap"
#: Time limit for completing the recordings of an interrupted run, seconds.
_INTERRUPTED_DRAIN_S = 1.2


class RecordError(ExportError):
    """A recording cannot be started, or is incomplete."""


class Recorder:
    """Makes the recordings of a run, one after the other.

    The first one starts immediately if `config` names a file; raises RecordError if it cannot. In `name`,
    that of further files, ``{date}`` becomes the date and time, and a number is added if the file exists. All
    are completed and logged at the end of a ``with`` block, which closes the source, also if Ctrl-C or an
    error ends it.
    """

    def __init__(self, config: RecordConfig, source: SourceProcess, *, name: str = DEFAULT_NAME) -> None:
        self._config, self._source, self._name = config, source, name
        self._is_wanted = False
        self._logged = 0
        if config.file is not None:
            self._begin(Path(config.file), config.delay_s)

    @property
    def recording(self) -> Recorded | None:
        """The recording that is being made, or was until the source ended or it failed."""
        return self._source.recordings[-1] if self._is_wanted else None

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
        self._begin(path, 0.0)
        return path

    def _begin(self, path: Path, delay_s: float) -> None:
        config = self._config
        options = RecordOptions(path, config.color, config.split_s, delay_s, config.space_min_mb)
        try:
            self._source.record(options)
        except (DriverError, OSError) as err:
            why = str(err) if isinstance(err, DriverError) else f"{path}: cannot be written: {err.strerror}"
            raise RecordError(why) from err
        self._is_wanted = True

    def end(self) -> None:
        """End the current recording; the frames that were taken are still written."""
        self._is_wanted = False
        self._source.end_recording()

    def log_finished(self) -> None:
        """Log recordings that have ended since; a failed one does not end the run."""
        for each in self._source.recordings[self._logged :]:
            if not each.ended or (each is self.recording and not each.failure):
                return
            self._logged += 1
            _log_ended(each)

    def figures(self) -> list[dict[str, Any]]:
        """Return the entries of all recordings in the run's report."""
        return [
            {
                "file": str(each.path),
                "files": [str(file) for file in each.files],
                "frames": each.frames,
                "lost": each.lost,
                "megabytes": each.written_mb,
                "failure": each.failure,
            }
            for each in self._source.recordings
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if isinstance(exception[1], KeyboardInterrupt):
            self._source.drain_s = _INTERRUPTED_DRAIN_S
        self._source.close()
        current = self.recording
        for each in self._source.recordings[self._logged :]:
            _log_ended(each)
        self._logged = len(self._source.recordings)
        # What ends the run is raised, and what is wrong with the recording only logged.
        if exception[0] is None and current is not None and current.failure:
            raise RecordError(_failure(current))


def _log_ended(recording: Recorded) -> None:
    if recording.failure:
        _log.error("%s", _failure(recording))
        return
    files = ", ".join(str(file) for file in recording.files)
    counted = recording.frames, recording.seconds, recording.written_mb
    _log.info("recorded %d frames, %.1f s, %.1f MB to %s", *counted, files)
    if recording.lost:
        _log.warning("%d frames are missing from %s: writing was too slow", recording.lost, recording.path)
    if recording.frames == 0:
        _log.warning("%s: no frames were recorded, so the file was not kept", recording.path)


def _failure(recording: Recorded) -> str:
    return f"{recording.failure}; the {recording.frames} previous frames can be replayed"
