"""Checks a folder of exports against itself, its settings and its recording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from nurbseg.app.evaluation.check.exported import ExportedFrame, Finding
from nurbseg.app.evaluation.check.floors import check_floors
from nurbseg.app.evaluation.check.history import History
from nurbseg.app.evaluation.check.merges import check_merges
from nurbseg.app.evaluation.check.reading import DamagedExportError, read_frame, read_settings
from nurbseg.app.evaluation.check.splits import check_splits
from nurbseg.app.evaluation.check.stops import check_live_stops, check_stops
from nurbseg.app.evaluation.check.structure import check_names, check_partition
from nurbseg.app.evaluation.check.surfaces import check_measured, check_surfaces
from nurbseg.app.evaluation.check.values import check_values
from nurbseg.drivers.datasets.sequence import natural_key
from nurbseg.drivers.errors import EndOfRecordingError, FrameFormatError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.drivers.source import FrameSource
from nurbseg.segmentation.points.depth_preparation import DepthPreparation
from nurbseg.segmentation.points.registration import register


class FolderCheck:
    """Checks the frames of a folder of exports.

    Nothing here calls what made the values: surfaces are evaluated by SciPy; metrics, ratios and the order of
    the tree are computed again. What is shared is the recording's frames and their registration. Without the
    recording that was segmented, no value is recomputed from points.

    Attributes
    ----------
    frames, segments, recomputed : int
        What was checked so far: frames, their segments, and those of them whose values were recomputed.
    history : History
        Their values and trials, and how many belong to frames that are not there.

    Raises
    ------
    ValueError
        If the folder holds no export, or a recording is given for one without surfaces.
    """

    def __init__(
        self, folder: Path, recording: str | None = None, options: SourceOptions | None = None
    ) -> None:
        self.frames = self.segments = self.recomputed = 0
        self.history = History()
        self._folder = folder
        self._recording = recording
        self._options = options or SourceOptions()
        self._settings = read_settings(folder)
        stems = (path.name.removesuffix("_tree.json") for path in folder.glob("*_tree.json"))
        # Files named as in their source are in its order, too.
        self._stems = sorted(stems, key=natural_key)
        if not self._stems:
            raise ValueError(f"{folder}: contains no NNNNNN_tree.json")
        if recording is not None and not self._settings.surfaces:
            raise ValueError(
                f"{folder}: contains no surfaces to recompute values from; --export-surfaces writes them"
            )
        if recording is not None and self._settings.depth.average_frames > 1:
            raise ValueError(
                f"{folder}: its depth was averaged over frames, which cannot be repeated; check without a "
                "recording"
            )
        noise = self._settings.config.extended.inverse_depth_noise
        self._preparation = DepthPreparation(self._settings.depth, noise)

    def findings(self) -> Iterator[Finding]:
        """Check frame after frame, and yield what is wrong."""
        with ExitStack() as stack:
            source = None
            if self._recording is not None:
                source = stack.enter_context(open_source(self._recording, self._options))
            for stem in self._stems:
                try:
                    frame = read_frame(self._folder, stem, self._settings)
                except DamagedExportError as err:
                    yield Finding(err.file, "", "", "a file of an export", str(err))
                    continue
                self.frames += 1
                self.segments += len(frame.segments)
                yield from self._check(frame, source)

    def _check(self, frame: ExportedFrame, source: FrameSource | None) -> Iterator[Finding]:
        names = list(check_names(frame))
        yield from names
        if names:
            # The rest asks which segment is part of which.
            return
        stops = check_stops if frame.settings.independent else check_live_stops
        for check in (check_partition, check_merges, check_splits, stops, self.history.check):
            yield from check(frame)
        if not frame.settings.surfaces:
            return
        yield from check_measured(frame)
        yield from check_surfaces(frame)
        if source is not None:
            yield from self._check_against(frame, _recorded(source, frame))

    def _check_against(self, frame: ExportedFrame, recorded: RGBDFrame | None) -> Iterator[Finding]:
        if recorded is None:
            yield Finding(frame.tree_file, "", "frame", "one of the recording", str(frame.number))
            return
        for field, expected, found in (
            ("name", recorded.name, frame.tree.name),
            ("timestamp_ns", recorded.timestamp_ns, frame.tree.timestamp_ns),
        ):
            if found != expected:
                yield Finding(frame.tree_file, "", field, f"{expected} as recorded", str(found))
        cloud = register(self._preparation.prepared(recorded))
        yield from check_values(frame, cloud)
        yield from check_floors(frame, cloud)
        self.recomputed += len(frame.surfaces)


def _recorded(source: FrameSource, frame: ExportedFrame) -> RGBDFrame | None:
    """Read on up to the frame of an export; None where the recording does not hold it."""
    while True:
        try:
            recorded = source.read()
        except FrameFormatError:
            continue
        except EndOfRecordingError:
            return None
        if recorded.index >= frame.number:
            return recorded if recorded.index == frame.number else None
