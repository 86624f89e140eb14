"""Recording to .oni by OpenNI2's recorder, which gets the images from the driver."""

import logging
from pathlib import Path

from nurbseg.app.recording.config import RecordConfig
from nurbseg.app.recording.recording import Recording
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.reconnect import Reconnecting, Recordable

_log = logging.getLogger(__name__)


class OniRecording(Recording):
    """Starts and stops a camera's recorder, on the thread that reads the camera.

    With `at_once` (nobody reads the camera yet) and no delay it starts immediately, and raises DriverError if
    it cannot; otherwise with the first frame. `frames` are those read while the recorder was running; none
    are `lost`, because the recorder has its own thread.
    """

    def __init__(self, path: Path, camera: Recordable, config: RecordConfig, *, at_once: bool = True) -> None:
        super().__init__(path, config)
        self._camera = camera
        self._lossy = config.color == "jpeg95"
        self._is_recording = self._is_finished = False
        if at_once and not self._delay_ns:
            self._start()

    @property
    def finished(self) -> bool:
        """Whether all frames are written, after `finish` or a failure."""
        return self._is_finished or self.ended

    @property
    def files(self) -> tuple[Path, ...]:
        """The files; several if the camera was disconnected in between."""
        later = self._camera.recorded_files[1:] if isinstance(self._camera, Reconnecting) else ()
        return (self.path, *later)

    def _start(self) -> None:
        self._camera.start_recording(self.path, lossy=self._lossy)
        self._is_recording = True

    def put(self, frame: RGBDFrame) -> None:
        """Start after the delay, and stop when the disk is nearly full."""
        # Starting the recorder resets the camera's clock.
        if self.failure or (not self._is_recording and self._is_early(frame)):
            return
        try:
            if not self._is_recording:
                self._start()
            reason = self._shortage()
            if not reason and not self.files[-1].exists():
                reason = f"{self.files[-1]} was deleted or moved"
            if reason:
                self._camera.stop_recording()
            elif isinstance(self._camera, Reconnecting):
                reason = self._camera.recording_failure
        except DriverError as err:
            reason = str(err)
        if reason:
            self._fail(reason)
        else:
            self.frames += 1
            self._add_time(frame)

    def _fail(self, reason: str) -> None:
        self._is_recording = False
        self.failure = f"{self.path}: recording stopped: {reason}"
        _log.error("%s", self.failure)

    def finish(self) -> None:
        """Finish the file; call from the thread that reads the camera, also twice."""
        if self._is_recording:
            self._is_recording = False
            try:
                self._camera.stop_recording()
            except DriverError as err:
                self._fail(str(err))
        self._is_finished = True

    def close(self) -> None:
        """Finish the file when nobody reads the camera any more; may be called twice."""
        self.finish()
