"""Logs results to a Rerun recording of the caller's, drawn as the viewer of ``nurbseg-live`` draws them."""

import rerun as rr

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.blueprint import legend
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.entities import LEGEND, FrameEntities, markdown, opening_entities
from nurbseg.app.view.stream import Writer, log_entities
from nurbseg.library.result import FrameResult

_VIEW = ViewConfig()
#: By the ID of a recording: its layout, its cameras and the names of its stages were logged.
_writers: dict[str | None, Writer] = {}


def show(result: FrameResult, recording: rr.RecordingStream | None = None) -> None:
    """Log a frame, its objects, surfaces and tree to a Rerun recording.

    Parameters
    ----------
    result : FrameResult
        The frame.
    recording : rerun.RecordingStream, optional
        Where it is logged: to a viewer, a file or both, as its sinks say. By default it is the recording of
        ``rerun.init``.

    Raises
    ------
    ValueError
        If there is no recording.
    """
    recording = recording or rr.get_global_data_recording()
    if recording is None:
        raise ValueError('recording: there is none; call rerun.init("name", spawn=True) first, or pass one')
    name = recording.get_recording_id()
    if (writer := _writers.get(name)) is None:
        writer = _writers[name] = Writer()
        text = markdown(legend(_VIEW, result.config))
        log_entities(recording, (*opening_entities(), (LEGEND, text)), static=True)
    writer.write(recording, FrameEntities(drawn(result, _VIEW, result.config.metric), _VIEW))
