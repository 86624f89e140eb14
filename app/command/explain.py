"""What ``nurbseg-live --explain`` does: it explains one frame instead of a run."""

from dataclasses import replace
from pathlib import Path

from nurbseg.app.live.opening import open_chosen
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.app.view.explaining import dated_folder, show_explanation, write_explanation
from nurbseg.app.view.viewer import check_rerun, chosen_mode, listens, reachable, start_viewer
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.points.depth_preparation import DepthPreparation

#: Longest wait for a frame, seconds.
_FRAME_S = 10.0


def explain(config: AppConfig) -> None:
    """Segment the frame that the configuration names, and write and show why it was segmented so.

    Raises DriverError if it cannot be read, ViewError if a viewer cannot be started, OSError if a file cannot
    be written, and ValueError if two sources are named.
    """
    check_rerun()
    config = _of_frame(config)
    opened = open_chosen(config)
    with opened.camera, opened.source:
        prepare = DepthPreparation(config.depth, config.segmentation.extended.inverse_depth_noise)
        result = process_frame(prepare.prepared(opened.source.read(_FRAME_S)), config.segmentation)
    directory = config.explain.directory
    recording = write_explanation(result, dated_folder(result) if directory is None else Path(directory))
    view = config.view
    if chosen_mode(view) == "spawn" and not listens(reachable(view.bind), view.port):
        start_viewer(view, view.port, str(recording))
    else:
        show_explanation(recording, view)


def _of_frame(config: AppConfig) -> AppConfig:
    """Return the configuration of a run that begins with the frame, and reads every one."""
    source, what = config.source, config.explain.what or ""
    if what.isdecimal():
        source = replace(source, start=int(what))
    elif source.named:
        raise ValueError(f"--explain {what}: expected the number of a frame, since a source is named too")
    else:
        source = replace(source, replay=what)
    return replace(config, source=replace(source, speed=0.0))
