"""One run: opens what it needs, segments frame after frame, and closes everything in the right order."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from nurbseg.app.command.config import AppConfig
from nurbseg.app.command.interruption import Interruption
from nurbseg.app.export import Exporter, ExportError, run_settings
from nurbseg.app.live.capture import CaptureThread
from nurbseg.app.live.latency_filter import Lateness
from nurbseg.app.live.opening import open_chosen
from nurbseg.app.live.progress import Progress
from nurbseg.app.live.report import RunReport
from nurbseg.app.live.tracking import Segmenter
from nurbseg.app.live.warmup import Loading
from nurbseg.app.recording.recorder import open_recording, tell_recorded
from nurbseg.app.result import FrameResult
from nurbseg.app.view.view import View, ViewError, open_view
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.process.child import ChildProcess

_log = logging.getLogger(__name__)

#: Time between two looks whether the run was interrupted, seconds.
_TAKE_TIMEOUT_S = 0.5
#: Frames after which all that a run needs was imported and compiled.
_SETTLED_FRAMES = 5

#: What a result is given to, and the name under which the time for that is told.
Consumer = tuple[str, Callable[[FrameResult], None]]


class SetupError(Exception):
    """The run cannot begin: no source, or nowhere to put the results."""


class NoFramesError(DriverError):
    """The source ended before it gave a single frame that can be read."""


def run(config: AppConfig, interruption: Interruption, view_process: ChildProcess | None = None) -> RunReport:
    """Segment a source's frames until it ends.

    Parameters
    ----------
    config : AppConfig
        What to do.
    interruption : Interruption
        Ends the run early; everything is closed then as well, and the report written.
    view_process : ChildProcess, optional
        Which shows and saves, if it was started for this configuration before.

    Raises
    ------
    SetupError
        If the source, a folder or a file cannot be opened.
    DriverError
        If the source fails on the way, or gives no frame.
    ExportError, ViewError
        If a result cannot be written, or a recording is not whole.
    KeyboardInterrupt
        If the run was interrupted.
    """
    with ExitStack() as stack:
        loading = _begin_loading(config)
        report: RunReport | None = None
        try:
            opened = open_chosen(config)
            stack.enter_context(opened.source)
            _log.info("source: %s", opened.uri)
            report = RunReport(config, opened.uri, opened.source.metadata)
            _write_report(config, report, None, "still running")
            temporal = config.live.follows(every_frame=opened.every_frame)
            # Where every frame is wanted, none is hurried, and none too late.
            target_hz = 0.0 if opened.every_frame else config.live.target_fps
            exports: list[Consumer] = []
            if config.export.directory is not None:
                settings = run_settings(
                    config.segmentation,
                    source=opened.uri,
                    temporal=temporal,
                    target_fps=target_hz,
                    surfaces=config.export.surfaces,
                )
                exporter = Exporter(Path(config.export.directory), settings)
                exports.append(("export", exporter.write))
            name = Path(opened.uri).name
            shown = config.shown
            if shown.save_index == "auto":
                shown = replace(shown, save_index="on" if opened.every_frame else "off")
            view = stack.enter_context(
                open_view(shown, config.segmentation, opened.source.metadata, name=name, process=view_process)
            )
            recording = open_recording(config.record, opened.camera, lossless=opened.every_frame)
        except (DriverError, ExportError, ViewError, OSError, ValueError, KeyboardInterrupt) as err:
            if report is not None:
                with suppress(ExportError):
                    _write_report(config, report, None, _reason(err, interruption))
            if isinstance(err, KeyboardInterrupt):
                raise
            raise SetupError(str(err)) from err
        if view.how_to_look:
            _log.info("to look: %s", view.how_to_look)

        capture = CaptureThread(opened.source, lossless=opened.every_frame, recording=recording)
        ended = "the source ended"
        try:
            with recording or nullcontext():
                if loading is not None:
                    loading.wait()
                with capture:
                    try:
                        if config.record.only:
                            _pass_by(capture, report, interruption)
                        else:
                            segmenter = Segmenter(
                                config.segmentation,
                                temporal=temporal,
                                target_hz=target_hz,
                                every_surface=bool(exports),
                            )
                            lateness = Lateness(0.0 if opened.every_frame else config.live.age_max_ms)
                            _work(capture, segmenter, exports, view, lateness, report, interruption)
                    finally:
                        interruption.hold()
            if recording is not None:
                tell_recorded(recording)
            if report.segmented + report.passed_by == 0:
                raise NoFramesError(f"{opened.uri}: no frame could be read ({capture.damaged} damaged)")
        except BaseException as err:
            ended = _reason(err, interruption)
            raise
        finally:
            report.view_peak_mb = view.peak_memory_mb()
            _write_report(config, report, capture, ended)
        if view.serving:
            _log.info("all frames are shown; Ctrl-C ends the serving")
            interruption.wait()
        return report


def _reason(err: BaseException, interruption: Interruption) -> str:
    """Return why a run ended that did not end by itself."""
    return "interrupted" if interruption.signal_number else f"{type(err).__name__}: {err}"


def _begin_loading(config: AppConfig) -> Loading | None:
    """Begin to load what a run needs; None where nothing is segmented, or no frame waits for it in vain."""
    source = config.source
    if config.record.only or (source.speed == 0 and (source.replay is not None or source.synthetic)):
        return None
    return Loading(config.segmentation, temporal=config.live.follows(every_frame=False))


def _work(
    capture: CaptureThread,
    segmenter: Segmenter,
    exports: Sequence[Consumer],
    view: View,
    lateness: Lateness,
    report: RunReport,
    interruption: Interruption,
) -> None:
    """Take frame after frame, segment it and hand it on, until the source ends."""
    progress = Progress(capture)
    while True:
        interruption.check()
        try:
            captured = capture.frames.take(_TAKE_TIMEOUT_S)
        except TimeoutError:
            progress.waiting()
            continue
        if captured is None:
            return
        waited_s = time.monotonic() - captured.arrived_s
        result = segmenter.process(captured.frame)
        elapsed_ms = {
            "wait": 1e3 * waited_s,
            **result.elapsed_ms,
            "capture_to_labels": 1e3 * (time.monotonic() - captured.arrived_s),
        }
        result = replace(result, elapsed_ms=MappingProxyType(elapsed_ms))
        shown: list[Consumer] = (
            [("show", view.show)] if lateness.admits(elapsed_ms["capture_to_labels"]) else []
        )
        for stage, consume in (*exports, *shown):
            started_s = time.perf_counter()
            consume(result)
            elapsed_ms[stage] = 1e3 * (time.perf_counter() - started_s)
        report.late = lateness.held_back
        report.add(elapsed_ms, result.events, result.revision)
        progress.segmented(result, late=lateness.held_back)
        if report.segmented == _SETTLED_FRAMES:
            # That stays for good, and looking for garbage in it takes a tenth of a second each time.
            gc.freeze()


def _pass_by(capture: CaptureThread, report: RunReport, interruption: Interruption) -> None:
    """Take frame after frame, which are recorded already, until the source or the recording ends."""
    progress = Progress(capture)
    while capture.recording is not None and not capture.recording.ended:
        interruption.check()
        try:
            captured = capture.frames.take(_TAKE_TIMEOUT_S)
        except TimeoutError:
            progress.waiting()
            continue
        if captured is None:
            return
        report.passed_by += 1
        progress.recorded()


def _write_report(config: AppConfig, report: RunReport, capture: CaptureThread | None, ended: str) -> None:
    if config.export.report is None:
        return
    path = Path(config.export.report)
    try:
        report.write(path, capture, ended)
    except OSError as err:
        raise ExportError(f"{path}: cannot be written: {err.strerror}") from err
