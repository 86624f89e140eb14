"""The content of a stream of a recording: how it begins, then frames and log lines."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from nurbseg.app.view.drawing.blueprint import blueprint
from nurbseg.app.view.drawing.entities import LOG, FrameEntities, camera_entities, stage_entities
from nurbseg.app.view.drawing.frame import Moment
from nurbseg.app.view.drawing.tree import Entities
from nurbseg.app.view.view_messages import Line
from nurbseg.drivers.calibration.cameras import calibration_table

APPLICATION = "nurbseg"

#: A device clock past this (the year 2001) is a date; otherwise it counts from an arbitrary start.
_EPOCH_NS = 1_000_000_000 * 10**9


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """How every recording begins.

    All sinks of a run share one `recording_id`, so that a viewer shows one recording. `properties` are by
    subject; `static` holds entity paths with what is valid at all times.
    """

    recording_id: str
    name: str
    properties: Mapping[str, rr.AnyValues]
    static: tuple[tuple[str, rr.AsComponents], ...]

    def stream(self) -> rr.RecordingStream:
        """Return a new stream without a sink."""
        return rr.RecordingStream(APPLICATION, recording_id=self.recording_id)

    def send(self, stream: rr.RecordingStream) -> None:
        """Log this to a stream that has a sink."""
        stream.send_recording_name(self.name)
        for name, values in self.properties.items():
            stream.send_property(name, values)
        log_entities(stream, self.static, static=True)


Item = FrameEntities | Line


def log_entities(stream: rr.RecordingStream, entities: Entities, *, static: bool = False) -> None:
    """Log each entity at its path, at the current time of this thread."""
    for path, entity in entities:
        stream.log(path, entity, static=static)


def set_time(stream: rr.RecordingStream, moment: Moment) -> None:
    """Set the time of what this thread logs next."""
    stream.set_time("frame", sequence=moment.frame)
    if moment.device_ns is None:
        return
    if moment.device_ns > _EPOCH_NS:
        stream.set_time("device_time", timestamp=np.datetime64(moment.device_ns, "ns"))
    else:
        stream.set_time("device_time", duration=np.timedelta64(moment.device_ns, "ns"))


class Writer:
    """Writes items to one stream, and the layout and the cameras whenever they change."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._cameras: dict[str, Any] = {}
        self._kind: tuple[bool, bool, bool] | None = None
        self._timeline = "frame"
        self._newest = 0
        self._stages: tuple[str, ...] = ()

    def write(self, item: Item) -> None:
        """Log a frame or a line at its time."""
        set_time(self._stream, item.moment)
        if isinstance(item, Line):
            self._stream.log(
                LOG, rr.TextLog(item.text, level=rr.LoggingHandler.LVL2NAME.get(item.level, "INFO"))
            )
            return
        frame = item.frame
        kind = frame.unregistered_color is None, frame.truth is not None, frame.objects is not None
        went_back = item.moment.frame < self._newest and self._timeline == "frame"
        self._newest = max(self._newest, item.moment.frame)
        if went_back:
            # A viewer follows the highest frame number, which is no longer the newest frame.
            self._timeline = "log_time"
        if kind != self._kind or went_back:
            self._kind = kind
            self._stream.send_blueprint(blueprint(frame, item.view, self._timeline))
        if (cameras := calibration_table(frame.calibration)) != self._cameras:
            self._cameras = cameras
            log_entities(self._stream, camera_entities(frame.calibration), static=True)
        if (stages := tuple(frame.elapsed_ms)) != self._stages:
            self._stages = stages
            log_entities(self._stream, stage_entities(stages), static=True)
        log_entities(self._stream, item.entities)
