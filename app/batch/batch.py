"""Segments every frame of many recordings, and resumes where it was interrupted."""

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from nurbseg.app.errors import ExportError, error_text
from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.run_settings import RunSettings, refuse_other_results
from nurbseg.app.frames import Reader, survey
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.app.workers import Workers, in_order
from nurbseg.common.errors import DriverError, FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import read_json, write_json
from nurbseg.drivers.options import SourceOptions
from nurbseg.segmentation.config import SegmentationConfig

#: The file with the progress of an export.
PROGRESS_FILE = "progress.json"
#: Frames of one task: an eighth of a second of work or more, by which workers may differ at the end.
_TASK_FRAMES = 4

#: The reader of each thread: a worker of a Dask cluster may have several.
_kept = threading.local()


@dataclass(slots=True, eq=False)
class Recording:
    """A recording, and its progress."""

    uri: str
    #: Folder of its results.
    directory: str
    frames: int = 0
    #: Number of frames that are segmented or damaged, from the first one on.
    done: int = 0
    #: What is wrong with damaged frames, by their position.
    damaged: dict[str, str] = field(default_factory=dict)
    #: Number of frames none of whose pixels has depth.
    without_depth: int = 0
    #: Frames segmented in this run, and the size of their files.
    segmented: int = 0
    bytes: int = 0
    #: Why it could not be completed.
    failure: str = ""

    @property
    def ended(self) -> bool:
        """Whether it is complete or has failed."""
        return bool(self.failure) or 0 < self.frames == self.done


#: Positions of successive frames of a recording, and its name.
_Task = tuple[range, str]
#: The files of a frame by name and whether it has depth, or what is wrong with it.
_Outcome = tuple[dict[str, bytes], bool] | str


def recordings_of(uris: Sequence[str], directory: Path) -> list[Recording]:
    """Return recordings with their folders, named like them; raises ValueError if two have the same."""
    found: dict[Path, str] = {}
    for uri in uris:
        parts = [part for part in Path(uri).parts if part not in ("/", "..")]
        folder = directory.joinpath(*parts)
        if folder in found:
            raise ValueError(f"{found[folder]}, {uri}: both would write results to {folder}")
        found[folder] = uri
    return [Recording(uri, str(folder)) for folder, uri in found.items()]


def run_batch(
    recordings: Sequence[Recording],
    workers: Workers,
    config: SegmentationConfig,
    options: SourceOptions,
    export: ExportConfig,
    report: Callable[[Recording], None] = lambda recording: None,
    computer: str = "",
) -> None:
    """Segment the frames of each recording that are not done yet.

    Only this process writes results, in the order of frames; they do not depend on the number of workers. If
    a recording fails, the run continues with the others. `report` is called with each when it has ended.
    `computer` is that of all workers, if they share one.
    """
    settings: dict[str, RunSettings] = {}
    exporters: dict[str, Exporter] = {}
    by_uri = {recording.uri: recording for recording in recordings}

    def tasks() -> Iterator[_Task]:
        for recording in recordings:
            try:
                settings[recording.uri] = _begun(recording, config, options, export, computer)
            except (DriverError, ExportError, OSError, ValueError) as err:
                recording.failure = str(err)
            if recording.ended:
                report(recording)
            for start in range(recording.done, recording.frames, _TASK_FRAMES):
                if not recording.failure:
                    yield range(start, min(start + _TASK_FRAMES, recording.frames)), recording.uri

    segment = partial(segment_run, config=config, options=options, export=export)
    try:
        for (run, uri), future in in_order(workers, segment, tasks()):
            recording = by_uri[uri]
            if recording.failure:
                continue
            try:
                outcomes = future.result()
                if uri not in exporters:
                    # Only now, as there would be an empty folder if no frame could be read.
                    forms = replace(export, force=True)
                    exporters[uri] = Exporter(Path(recording.directory), settings[uri], forms)
                _keep(recording, outcomes, exporters[uri])
            except Exception as err:
                recording.failure = f"frames {run.start} to {run.stop - 1}: {error_text(err)}"
            if recording.ended:
                report(recording)
    finally:
        _reader().close()


def _begun(
    recording: Recording,
    config: SegmentationConfig,
    options: SourceOptions,
    export: ExportConfig,
    computer: str,
) -> RunSettings:
    """Read the progress of a recording, and return the settings of its export."""
    folder = Path(recording.directory)
    path = folder / PROGRESS_FILE
    try:
        before = read_json(path)
        # Earlier versions did not count frames without depth.
        frames, done, without_depth = (before.get(name, 0) for name in ("frames", "done", "without_depth"))
        if not all(isinstance(each, int) for each in (frames, done, without_depth)) or not 0 < done <= frames:
            counted = f"{quoted(done)} of {quoted(frames)}"
            raise ValueError(f"{path}: done: expected a number of frames, got {counted}")
        if not isinstance(before.get("damaged"), dict):
            raise ValueError(f"{path}: damaged: expected an object, got {quoted(before.get('damaged'))}")
        recording.done, recording.damaged, recording.without_depth = done, before["damaged"], without_depth
    except FileNotFoundError:
        frames = None
    except ValueError as err:
        raise ExportError(f"{err}; delete {folder} to start over") from err
    calibration = None
    try:
        positions, calibration = survey(recording.uri, options)
        found = len(positions)
    except DriverError:
        # The recording of a complete export may be gone.
        if frames is None or recording.done < frames:
            raise
        found = frames
    settings = RunSettings(
        config,
        source=recording.uri,
        surfaces=export.surfaces,
        camera=calibration,
        depth_scale=options.depth_scale,
        computer=computer,
    )
    refuse_other_results(folder, settings)
    if frames not in (None, found):
        recording.done = 0
        raise ExportError(
            f"{recording.uri}: has {found} frames, but had {frames} when this batch started; delete {folder}"
        )
    if not found:
        raise ExportError(f"{recording.uri}: contains no frames")
    recording.frames = found
    return settings


def _keep(recording: Recording, outcomes: Sequence[_Outcome], exporter: Exporter) -> None:
    """Write the files of successive frames, and then the recording's progress."""
    for outcome in outcomes:
        if isinstance(outcome, str):
            recording.damaged[str(recording.done)] = outcome
        else:
            files, has_depth = outcome
            exporter.write_files(files)
            recording.segmented += 1
            recording.without_depth += not has_depth
            recording.bytes += sum(map(len, files.values()))
        recording.done += 1
    progress = {name: getattr(recording, name) for name in ("frames", "done", "damaged", "without_depth")}
    path = exporter.directory / PROGRESS_FILE
    try:
        write_json(path, progress)
    except OSError as err:
        raise ExportError(f"{path}: cannot be written: {err.strerror}") from err


def segment_run(
    task: _Task, *, config: SegmentationConfig, options: SourceOptions, export: ExportConfig
) -> list[_Outcome]:
    """Segment successive frames of a recording independently; return what became of each.

    Raises DriverError if the recording cannot be read, or ends early.
    """
    # Late: with workers, the process that writes the files does not load it.
    from nurbseg.app.live.parallel import segment_alone

    outcomes: list[_Outcome] = []
    run, uri = task
    for frame in _reader().read(uri, options, run):
        if isinstance(frame, FrameFormatError):
            outcomes.append(str(frame))
        else:
            files = segment_alone(frame, config, export=export).files
            outcomes.append((dict(files), bool(frame.depth_mm.any())))
    if len(outcomes) < len(run):
        raise RecordingFormatError(f"{uri}: ends after {run.start + len(outcomes)} frames")
    return outcomes


def _reader() -> Reader:
    """Return the reader of this thread."""
    reader: Reader = getattr(_kept, "reader", None) or Reader()
    _kept.reader = reader
    return reader
