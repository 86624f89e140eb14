"""The viewer, recorder and streams of `nurbseg-live` for frames that a program has itself."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from nurbseg.app.publish.opening import open_publisher
from nurbseg.app.recording.recording import Recording
from nurbseg.app.settings.output_config import PublishConfig, RecordConfig, ViewConfig, ViewMode
from nurbseg.app.view.opening import chosen_view, open_view
from nurbseg.common.closing import Closing
from nurbseg.common.errors import DriverError
from nurbseg.common.files import check_absent
from nurbseg.common.frame import RGBDFrame, check_frame
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.source import FrameSource
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import SegmentationConfig


class LiveApp(Closing):
    """Segments the frames of a program, and shows, records and publishes them as ``nurbseg-live`` does.

    Use it in a ``with`` block, so that files are complete at its end.

    Parameters
    ----------
    config : SegmentationConfig, optional
        Settings of the segmentation.
    view : {"auto", "spawn", "connect", "serve", "none"}
        As ``--view``.
    save : str, optional
        File (.rrd) of what is shown.
    record : str, optional
        File (.mcap) of the frames, which must not exist.
    publish : str, optional
        As ``--publish``: ``"foxglove"``, ``"jsonl:PATH"``.
    save_objects : str, optional
        File (.mcap) of the results as ROS 2 messages, which must not exist.
    target_hz : float
        Frame rate to maintain by doing less per frame, 1/s; 0 to never do less.
    name : str
        What the viewer calls it.

    Attributes
    ----------
    viewer_hint : str
        What a user must do to see it; empty if a window opens.

    Raises
    ------
    ValueError
        If a setting is out of bounds.
    FileExistsError
        If `record` exists.
    ViewError, PublishError
        If a viewer, file or address cannot be opened.
    """

    def __init__(
        self,
        config: SegmentationConfig | None = None,
        *,
        view: ViewMode = "auto",
        save: str | None = None,
        record: str | None = None,
        publish: str | None = None,
        save_objects: str | None = None,
        target_hz: float = 30.0,
        name: str = "nurbseg",
    ) -> None:
        shown = chosen_view(ViewConfig(mode=view, save=save), interactive=True)
        self._record = RecordConfig(file=record)
        if record is not None:
            check_absent(Path(record))
        self._recording: Recording | None = None
        self._segmenter = Segmenter(config, target_hz=target_hz)
        self._frames, self._is_closed = 0, False
        with ExitStack() as stack:
            self._publisher = open_publisher(
                PublishConfig(how=publish, file=save_objects), self._segmenter.config, every=False
            )
            if self._publisher is not None:
                stack.callback(self._publisher.close)
            self._view = stack.enter_context(open_view(shown, self._segmenter.config, name=name))
            self._view.every_frame_in_full = False
            self.viewer_hint = self._view.viewer_hint
            self._stack = stack.pop_all()

    def process(self, frame: RGBDFrame) -> FrameResult:
        """Segment a frame; show, record and publish it.

        Frames are numbered in order; one without a time (``timestamp_ns`` 0) gets the present one.

        Raises
        ------
        ViewError
            If the view has failed.
        DriverError
            If it is closed.
        TypeError
            If the frame is something else.
        """
        check_frame(frame)
        if self._is_closed:
            raise DriverError("LiveApp is closed")
        arrived_s = time.monotonic()
        frame = replace(
            frame,
            index=self._frames,
            timestamp_ns=frame.timestamp_ns or time.time_ns(),
            arrived_s=frame.arrived_s or arrived_s,
        )
        self._frames += 1
        if self._record.file is not None:
            self._recorded(frame, Path(self._record.file))
        result = self._segmenter.process(frame)
        if self._publisher is not None:
            self._publisher.publish(result)
        self._view.show(result)
        return result

    def results(self, source: FrameSource) -> Iterator[FrameResult]:
        """Yield the result of each frame of a source, the newest of a camera, until it ends.

        Raises
        ------
        DriverError
            As the source does.
        ViewError
            If the view has failed.
        """
        for frame in source:
            yield self.process(frame)

    def _recorded(self, frame: RGBDFrame, path: Path) -> None:
        if self._recording is None:
            calibration, color = frame.calibration, self._record.color

            def open_file(part: Path) -> RecordingWriter:
                return RecordingWriter(part, calibration, color_format=color, metadata={})

            self._recording = self._stack.enter_context(Recording(path, open_file, self._record))
        self._recording.put(frame)

    def close(self) -> None:
        """Complete and close everything; may be called twice."""
        self._is_closed = True
        self._stack.close()
