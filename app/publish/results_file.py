"""Results as ROS 2 messages in an MCAP file, which Foxglove, Rerun and ROS 2 open."""

from pathlib import Path

from mcap_ros2.writer import Writer

from nurbseg.app.errors import PublishError
from nurbseg.app.publish.publisher import Sink
from nurbseg.app.publish.ros_results import DEFINITIONS, result_messages
from nurbseg.app.recording.recording import free_space
from nurbseg.common.closing import closed_on_error
from nurbseg.common.files import create_private
from nurbseg.common.limits import STAMP_END_NS
from nurbseg.library.result import FrameResult

#: Results that may wait for the disk: half a second, and some 100 MB.
_WAITING_MAX = 16
#: Longest wait for the disk at the end, seconds.
_END_S = 10.0
#: Disk space that is left free, bytes.
_SPACE_MIN = 200_000_000
#: Bytes after which a chunk ends: with the points of each frame.
_CHUNK_BYTES = 500_000


class ResultsFile(Sink):
    """Writes the messages of every frame to a new file; one without frames is removed at the end.

    Raises PublishError if the file exists or cannot be created.
    """

    waiting_max, end_s, is_file = _WAITING_MAX, _END_S, True

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path
        self._frames = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = create_private(path)
            with closed_on_error(self._file.close):
                self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
                self._schemas = {
                    name: self._writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()
                }
        except OSError as err:
            raise PublishError(f"{path}: {err.strerror or err}") from err

    def publish(self, result: FrameResult) -> None:
        """Write a frame; raises PublishError if the disk is nearly full, or its time cannot be written."""
        stamp = result.frame.timestamp_ns
        if not 0 <= stamp < STAMP_END_NS:
            raise PublishError(f"{self._path}: timestamp_ns: expected a time from 1970 to 2038, got {stamp}")
        if free_space(self._path) < _SPACE_MIN:
            raise PublishError(f"{self._path}: less than {_SPACE_MIN // 1_000_000} MB of disk space are left")
        try:
            for topic, kind, content in result_messages(result):
                self._writer.write_message(
                    topic,
                    self._schemas[kind],
                    content,
                    log_time=stamp,
                    publish_time=stamp,
                    sequence=self._frames,
                )
            self._file.flush()
        except OSError as err:
            raise PublishError(f"{self._path}: {err.strerror}; {self._frames} frames are in it") from err
        self._frames += 1

    def close(self) -> None:
        """Write the index and close the file; raises PublishError if the disk is full."""
        try:
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
            finally:
                self._file.close()
        except OSError as err:
            raise PublishError(f"{self._path}: {err.strerror}; it has no index") from err
        if not self._frames:
            self._path.unlink()
