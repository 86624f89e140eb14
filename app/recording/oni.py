"""Recording by OpenNI2's own recorder, which takes the images from the driver and not from us."""

from __future__ import annotations

import logging
from pathlib import Path

from nurbseg.app.recording.config import RecordConfig
from nurbseg.app.recording.recording import Recording
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.reconnect import Reconnecting, Recordable

_log = logging.getLogger(__name__)


class OniRecording(Recording):
    """Starts and stops the recorder of a camera, on the thread that reads the camera.

    It begins now where `at_once` says that nobody reads the camera yet and no delay is set, and raises
    DriverError if it cannot; or else with the first frame. `frames` are those read while the recorder was at
    work, give or take those on their way as it began; none are `lost`, because the recorder has a thread and
    a processor core of its own.
    """

    def __init__(self, path: Path, camera: Recordable, config: RecordConfig, *, at_once: bool = True) -> None:
        super().__init__(path, config)
        self._camera = camera
        self._lossy = config.color == "jpeg95"
        self._is_recording = self._is_finished = False
        if at_once and not self._delay_ns:
            self._start()

    @property
    def ended(self) -> bool:
        """Whether nothing more is written."""
        return bool(self.failure)

    @property
    def finished(self) -> bool:
        """Whether what came is written, after `finish` or a failure."""
        return self._is_finished or self.ended

    @property
    def files(self) -> tuple[Path, ...]:
        """The files; more than one where the camera was away in between."""
        later = self._camera.recorded_files[1:] if isinstance(self._camera, Reconnecting) else ()
        return (self.path, *later)

    def _start(self) -> None:
        self._camera.start_recording(self.path, lossy=self._lossy)
        self._is_recording = True

    def put(self, frame: RGBDFrame) -> None:
        """Begin when it is time, and end when the disk is nearly full; for the thread that reads."""
        # Once it is recording, the camera's clock has started again from zero.
        if self.failure or (not self._is_recording and self._is_early(frame)):
            return
        try:
            if not self._is_recording:
                self._start()
            missing = self._shortage()
            if not missing and not self.files[-1].exists():
                missing = f"{self.files[-1]} was deleted or moved"
            if missing:
                self._is_recording = False
                self._camera.stop_recording()
                self._fail(missing)
                return
            if isinstance(self._camera, Reconnecting) and self._camera.recording_failure:
                self._is_recording = False
                self._fail(self._camera.recording_failure)
                return
        except DriverError as err:
            self._fail(str(err))
            return
        self.frames += 1
        self._add_time(frame)

    def _fail(self, reason: str) -> None:
        self.failure = f"{self.path}: recording stopped: {reason}"
        _log.error("%s", self.failure)

    def finish(self) -> None:
        """Finish the file, as no frame follows; for the thread that reads, and safe to call twice."""
        if self._is_recording:
            self._is_recording = False
            try:
                self._camera.stop_recording()
            except DriverError as err:
                self._fail(str(err))
        self._is_finished = True

    def close(self) -> None:
        """Finish the file, for when nobody reads the camera any more; safe to call twice."""
        self.finish()
