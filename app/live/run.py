"""One run: opens source and outputs, segments frames, and closes everything in order."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.app.errors import ExportError, PublishError, ViewError, error_text
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.live.controls import Controls
from nurbseg.app.live.feed import Feed, open_status_line, wait_for_quit
from nurbseg.app.live.interruption import Interruption
from nurbseg.app.live.opening import OpenedSource, open_chosen, watched
from nurbseg.app.live.progress import Progress
from nurbseg.app.live.report import RunReport
from nurbseg.app.recording.recorder import DEFAULT_NAME, Recorder
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.app.settings.output_config import dated
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.view import LatencyFilter, View
from nurbseg.common.computer import leave_a_core, made_by, process_count
from nurbseg.common.errors import DriverError
from nurbseg.common.files import check_absent, remove_output

if TYPE_CHECKING:
    from nurbseg.app.export.exporter import Exporter
    from nurbseg.app.live.warmup import WarmUp
    from nurbseg.app.publish.publisher import Publisher
    from nurbseg.common.frame import RGBDFrame
    from nurbseg.common.process.child import ChildProcess
    from nurbseg.library.result import FrameResult
    from nurbseg.library.segmenter import Segmenter

_log = logging.getLogger(__name__)

#: Number of frames after which everything is imported and compiled.
_SETTLED_FRAMES = 5


class SetupError(Exception):
    """The run cannot start: a source, folder or file cannot be opened."""


@dataclass(slots=True)
class _Parts:
    """The parts of a run, once they are opened."""

    config: AppConfig
    settings: RunSettings
    opened: OpenedSource
    recorder: Recorder
    exporter: Exporter | None
    view: View
    publisher: Publisher | None
    report: RunReport
    controls: Controls
    warm_ups: list[WarmUp]


def run(
    config: AppConfig,
    interruption: Interruption,
    source_process: ChildProcess | None = None,
    view_process: ChildProcess | None = None,
) -> RunReport:
    """Segment a source's frames until it ends, or `interruption` ends the run.

    In any case everything is closed and, once the run has started, the report written. `source_process` runs
    the program of the source already, and `view_process` comes from `begin_view`.

    Raises SetupError if the source, a folder or a file cannot be opened; DriverError if the source fails
    later or has no frames; ExportError, PublishError or ViewError if a result cannot be written or a
    recording is incomplete; and KeyboardInterrupt if the run was interrupted.
    """
    _refuse_existing(config)
    with ExitStack() as stack:
        with _setup():
            parts = _opened(config, stack, source_process, view_process)
        view, report = parts.view, parts.report
        if view.viewer_hint:
            _log.info("to look: %s", view.viewer_hint)
        with _reported(report, interruption):
            with parts.recorder, watched(config.source.replay), ExitStack() as reading:
                feed = _begun(parts, interruption, reading)
                if config.record.only:
                    _only_record(parts, feed)
                elif (count := process_count(config.source.workers)) > 1:
                    _segment_in_parallel(parts, feed, count)
                else:
                    _segment(parts, feed)
            _check(parts)
        report.warn_of_missing()
        if view.serving and not report.quit:
            feed.progress.end()
            wait_for_quit(config.live.control, interruption)
        return report


def _opened(
    config: AppConfig,
    stack: ExitStack,
    source_process: ChildProcess | None,
    view_process: ChildProcess | None,
) -> _Parts:
    """Open the source and the outputs, which the stack closes."""
    if config.export.cad is not None:
        from nurbseg.app.export.exporter import check_libraries

        check_libraries(config.export)
    record_name = config.record.file or DEFAULT_NAME
    if config.record.file is not None:
        config = replace(config, record=replace(config.record, file=dated(config.record.file)))
    warm_ups: list[WarmUp] = []
    opened = open_chosen(config, source_process, lambda: warm_ups.extend(_loaded(config)))
    source = stack.enter_context(opened.source)
    _log.info("source: %s", opened.uri)
    _check_workers(config, opened)
    camera = source.calibration.depth
    config.depth.check_crop(camera.width, camera.height)
    settings, exporter = _settings(config, opened), None
    if config.export.directory is not None:
        from nurbseg.app.export.exporter import Exporter

        exporter = Exporter(Path(config.export.directory), settings, config.export)
    recorder = Recorder(config.record, source, name=record_name)
    fixed = "" if exporter is None else "an export holds results of one run's settings only"
    controls = Controls(config.segmentation, source, recorder, fixed=fixed, segments=not config.record.only)
    shown = config.shown
    if shown.save_index == "auto":
        shown = replace(shown, save_index="on" if opened.apart else "off")
    if config.export.force and shown.save is not None:
        remove_output(Path(shown.save))
    view = open_view(
        shown,
        config.segmentation,
        source.metadata,
        name=Path(opened.uri).name,
        process=view_process,
        is_outlived=lambda: exporter is not None or recorder.has_recorded,
        ask=controls.ask,
    )
    stack.enter_context(view)
    publisher = None
    if config.publish.is_wanted:
        from nurbseg.app.publish.opening import open_publisher

        publisher = open_publisher(config.publish, config.segmentation, every=opened.apart, ask=controls.ask)
        stack.callback(publisher.close)
    report = RunReport(config, opened.uri, source, recorder, publisher, view)
    report.write()
    return _Parts(config, settings, opened, recorder, exporter, view, publisher, report, controls, warm_ups)


def _begun(parts: _Parts, interruption: Interruption, reading: ExitStack) -> Feed:
    """Begin to read; return the frames."""
    source = parts.opened.source
    if parts.publisher is not None:
        # What was published is in the report.
        reading.callback(parts.publisher.close)
    for warm_up in parts.warm_ups:
        warm_up.wait()
    # All that was imported is permanent.
    gc.freeze()
    gc.enable()
    if parts.config.live.paused:
        source.step()
    line = reading.enter_context(open_status_line(parts.config.live.control))
    reading.callback(interruption.hold)
    progress = Progress(source, parts.recorder, line, Path(parts.opened.uri).name, tell=parts.view.tell)
    feed = Feed(source, progress, interruption, takes=not parts.config.record.only)
    if feed.takes:
        from nurbseg.segmentation.points.depth_preparation import DepthPreparation

        noise = parts.config.segmentation.extended.inverse_depth_noise
        feed.preparation = DepthPreparation(parts.config.depth, noise)
    return feed


def _check(parts: _Parts) -> None:
    """Raise an error if there was no frame, or if results are missing where they are published."""
    config, report, source = parts.config, parts.report, parts.opened.source
    if report.segmented + report.recorded_only == 0 and not report.quit:
        start = f" after --start {config.source.start}" if config.source.start else ""
        damaged = f"({source.status.damaged} damaged)"
        raise DriverError(f"{parts.opened.uri}: no frame could be read{start} {damaged}")
    if parts.publisher is not None and parts.publisher.failure:
        raise PublishError(f"results are missing: {parts.publisher.failure}")


def _refuse_existing(config: AppConfig) -> None:
    """Raise SetupError if an output may not be written, before a camera is opened and files are created."""
    replaceable = {config.record.file: False, config.shown.save: True, config.export.report: True}
    for file, is_replaceable in replaceable.items():
        try:
            if file is not None:
                check_absent(Path(file), force=config.export.force and is_replaceable)
        except OSError as err:
            can_force = is_replaceable and isinstance(err, FileExistsError)
            raise SetupError(f"{file}: {err.strerror}{', or overwrite it with --force' * can_force}") from err


@contextmanager
def _setup() -> Iterator[None]:
    """Raise errors of the block as `SetupError`."""
    try:
        yield
    except (DriverError, ExportError, PublishError, ViewError, OSError, ValueError) as err:
        raise SetupError(str(err)) from err


@contextmanager
def _reported(report: RunReport, interruption: Interruption) -> Iterator[None]:
    """Write the report after the block, with the reason why the run ended."""
    try:
        yield
    except BaseException as err:
        ended = "interrupted" if interruption.signal_number else error_text(err)
        if report.segmented + report.recorded_only:
            _log.info("%s%s", "interrupted: " if interruption.signal_number else "", report.summary())
        try:
            report.write(ended)
        except ExportError as second:
            _log.error("%s", second)
        raise
    report.write("quit" if report.quit else "the source ended")


def _loaded(config: AppConfig) -> list[WarmUp]:
    """Import what segments; return a warm-up that has begun, unless frames wait for the segmentation."""
    if config.record.only:
        return []
    import cv2

    from nurbseg.app.live.warmup import WarmUp

    # Before any is started: a thread of OpenCV's waits longer for a core than its share of an image takes.
    cv2.setNumThreads(1)
    if config.every_frame and config.source.replayed is not None:
        return []
    draws = config.shown.is_wanted or config.publish.is_wanted
    return [WarmUp(config.segmentation, temporal=config.live.follows(every_frame=False), draws=draws)]


def _check_workers(config: AppConfig, opened: OpenedSource) -> None:
    if config.source.workers == 1:
        return
    if not opened.every_frame:
        raise ValueError("--workers: only for replays of every frame: no camera, and --speed 0")
    if config.publish.is_wanted:
        raise ValueError("--workers: results are published in order by one process; leave out --publish")
    if config.live.follows(every_frame=opened.apart):
        raise ValueError(
            "--workers: a frame that continues the previous one must wait for it; use --temporal off"
        )


def _settings(config: AppConfig, opened: OpenedSource) -> RunSettings:
    return RunSettings(
        config.segmentation,
        source=opened.uri,
        temporal=config.live.follows(every_frame=opened.apart),
        target_fps=0.0 if opened.every_frame else config.live.target_fps,
        surfaces=config.export.surfaces,
        depth=config.depth,
        camera=opened.source.calibration,
        # Cameras say it themselves.
        depth_scale=None if opened.source.live else config.source.depth_scale,
        computer="" if config.export.directory is None else made_by(),
        trials_max=config.live.trials_max,
    )


def _only_record(parts: _Parts, feed: Feed) -> None:
    """Wait until the source ends, which its process records, or the recording fails."""
    with closing(feed.controlled(parts.config.live.control, parts.controls)) as frames:
        for _ in frames:
            pass
    parts.report.quit = parts.controls.ended


def _segment_in_parallel(parts: _Parts, feed: Feed, count: int) -> None:
    """Segment frames in several processes."""
    from nurbseg.app.live.parallel import run_in_parallel

    parts.controls.close()
    run_in_parallel(parts.config.segmentation, feed, count, parts.exporter, parts.view, parts.report)


def _segment(parts: _Parts, feed: Feed) -> None:
    """Segment frames and pass the results on until the source ends."""
    from nurbseg.library.segmenter import Segmenter

    config, settings, source, report = parts.config, parts.settings, parts.opened.source, parts.report
    controls = parts.controls
    latency_filter = LatencyFilter(0.0 if parts.opened.every_frame else config.live.age_max_ms)
    segmenter: Segmenter | None = None
    with closing(feed.controlled(config.live.control, controls)) as frames:
        for frame in frames:
            # Another thread may change it meanwhile.
            chosen = controls.config
            if segmenter is None or chosen is not segmenter.config:
                settings = replace(settings, config=chosen)
                segmenter = Segmenter(
                    chosen,
                    temporal=settings.temporal,
                    target_hz=settings.target_fps,
                    trials_max=config.live.trials_max,
                    every_surface=parts.exporter is not None,
                )
                if parts.publisher is not None:
                    parts.publisher.configured(chosen)
            result = _segmented(segmenter, frame, source_hz=feed.source_hz, is_live=source.live)
            result = _passed_on(result, parts, latency_filter)
            if controls.wanted:
                from nurbseg.app.live.snapshot import write_wanted

                write_wanted(result, settings, controls, config.shown)
            report.late = latency_filter.held_back
            leaves, objects = len(result.tree.leaf_names), len(result.tree.objects)
            report.add(result.elapsed_ms, result.events, result.update, objects=objects)
            feed.progress.segmented(frame, leaves, result.elapsed_ms, objects=objects, late=report.late)
            if report.segmented == _SETTLED_FRAMES:
                # These objects are permanent; collecting garbage among them takes a tenth of a second.
                gc.freeze()
                # Nothing is compiled any more, for which all cores are used.
                leave_a_core(set(threading.enumerate()) - {threading.current_thread()})
    report.quit = controls.ended


def _segmented(segmenter: Segmenter, frame: RGBDFrame, *, source_hz: float, is_live: bool) -> FrameResult:
    """Segment a frame; the result also says how long the frame waited, and how old it was at the end."""
    waited_ms = 1e3 * (frame.age_s or 0.0)
    # One of a recording is not of now.
    given = frame if is_live else replace(frame, arrived_s=None)
    result = segmenter.process(given, source_hz=source_hz, waited_ms=waited_ms)
    latency_ms = 1e3 * (frame.age_s or 0.0)
    stages_ms = {"wait": waited_ms, **result.elapsed_ms, "capture_to_labels": latency_ms}
    return replace(result, elapsed_ms=stages_ms)


def _passed_on(result: FrameResult, parts: _Parts, latency_filter: LatencyFilter) -> FrameResult:
    """Publish, export and show a result; return it with the times of these stages."""
    view, source = parts.view, parts.opened.source
    view.every_frame_in_full = parts.opened.every_frame or source.paused
    if parts.publisher is not None:
        parts.publisher.publish(result)
    stages: list[tuple[str, Callable[[FrameResult], None]]] = []
    if parts.exporter is not None:
        stages.append(("export", parts.exporter.write))
    # During a pause, the user waits for this frame.
    if latency_filter.passes(0.0 if source.paused else result.elapsed_ms["capture_to_labels"]):
        stages.append(("show", view.show))
    for stage, consume in stages:
        started_s = time.perf_counter()
        consume(result)
        stage_ms = 1e3 * (time.perf_counter() - started_s)
        result = replace(result, elapsed_ms={**result.elapsed_ms, stage: stage_ms})
    return result
