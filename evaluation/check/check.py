"""Checks a folder of exports for consistency with itself, its settings and its recording."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from nurbseg.app.export.run_settings import SETTINGS_FILE, differences
from nurbseg.common.errors import EndOfRecordingError, FrameFormatError
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.drivers.calibration.cameras import calibration_table
from nurbseg.drivers.datasets.sequence import natural_key
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.drivers.source import FrameSource
from nurbseg.evaluation.check.evidence import check_evidence
from nurbseg.evaluation.check.exported import ExportedFrame, Finding
from nurbseg.evaluation.check.objects import check_object_points, check_objects
from nurbseg.evaluation.check.reading import DamagedExportError, read_frame, read_settings
from nurbseg.evaluation.check.splits import check_live_stops, check_splits, check_stops
from nurbseg.evaluation.check.structure import check_merges, check_names, check_partition
from nurbseg.evaluation.check.surfaces import check_measured, check_surfaces
from nurbseg.evaluation.check.values import check_floors, check_values
from nurbseg.segmentation.points.depth_preparation import DepthPreparation
from nurbseg.segmentation.points.registration import Registration

#: Largest difference between a given rotation and the exact one that recordings store.
_RIGID = 1e-3


class FolderCheck:
    """Checks the frames of a folder of exports.

    The checks share no code with the segmentation but the reading and registration of frames: surfaces are
    evaluated with SciPy; metrics, ratios and the order of the tree are computed independently. Values are
    recomputed from points only with the recording that was segmented.

    Raises ValueError if the folder contains no export, or a recording is given for one without surfaces.
    """

    def __init__(
        self, folder: Path, recording: str | None = None, options: SourceOptions | None = None
    ) -> None:
        #: What was checked so far; `recomputed` counts segments whose values were recomputed, and `unchecked`
        #: values and trials from frames that are not in the export.
        self.frames = self.segments = self.recomputed = self.unchecked = 0
        #: By field and frame.
        self._known: dict[tuple[str, int], set[object]] = {}
        self._folder = folder
        self._recording = recording
        self._settings = read_settings(folder)
        options = options or SourceOptions()
        # Of the depth scale, the export knows what was given.
        self._options = replace(options, depth_scale=options.depth_scale or self._settings.depth_scale)
        stems = (path.name.removesuffix("_tree.json") for path in folder.glob("*_tree.json"))
        # This is also the order of files that are named as in their source.
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
        self._registration = Registration()
        self._preparation = DepthPreparation(self._settings.depth, noise)

    def findings(self) -> Iterator[Finding]:
        """Check all frames, and yield what is wrong."""
        with ExitStack() as stack:
            source = None
            if self._recording is not None:
                source = stack.enter_context(open_source(self._recording, self._options))
                if unlike := self._unlike(source.calibration):
                    yield Finding(SETTINGS_FILE, "", "camera", "that of the recording as given here", unlike)
                    # With other points, no value would be as exported.
                    source = None
            for stem in self._stems:
                try:
                    frame = read_frame(self._folder, stem, self._settings)
                except DamagedExportError as err:
                    yield Finding(err.file, "", "", "a file of an export", str(err))
                    continue
                self.frames += 1
                self.segments += len(frame.segments)
                try:
                    self._check(frame, source)
                finally:
                    yield from frame.findings

    def _unlike(self, calibration: Calibration) -> str:
        """Describe how the cameras of the export differ from those of the recording; empty if they agree."""
        if self._settings.camera is None:
            return ""
        exported, recorded = calibration_table(self._settings.camera), calibration_table(calibration)
        if np.allclose(exported["color_from_depth"], recorded["color_from_depth"], atol=_RIGID):
            recorded["color_from_depth"] = exported["color_from_depth"]
        return ", ".join(differences(exported, recorded))

    def _check(self, frame: ExportedFrame, source: FrameSource | None) -> None:
        check_names(frame)
        if frame.findings:
            # The other checks need to know which segment is part of which.
            return
        stops = check_stops if frame.settings.independent else check_live_stops
        for check in (check_partition, check_merges, check_splits, stops, self._check_earlier):
            check(frame)
        check_objects(frame)
        check_evidence(frame)
        if frame.settings.surfaces:
            check_measured(frame)
            check_surfaces(frame)
            if source is not None:
                self._check_against(frame, _recorded(source, frame))

    def _check_earlier(self, frame: ExportedFrame) -> None:
        """Check values and trials from earlier frames, and remember those of this frame."""
        now = frame.tree.frame
        own = {"value": set[object](), "trial": set[object]()}
        for name, segment in frame.segments.items():
            for field, number, found in (
                ("value", segment.measured, (segment.value, segment.points)),
                ("trial", segment.judged, segment.trial),
            ):
                if number == now:
                    own[field].add(found)
                elif number < now and (field, number) not in self._known:
                    self.unchecked += 1
                elif found not in self._known.get((field, number), ()):
                    frame.wrong(name, field, f"one of frame {number}, as the file says", found)
        self._known |= {(field, now): values for field, values in own.items()}

    def _check_against(self, frame: ExportedFrame, recorded: RGBDFrame | None) -> None:
        if recorded is None:
            frame.wrong("", "frame", "one of the recording, without its repeats", frame.tree.frame)
            return
        frame.compare("", "name", recorded.name, frame.tree.name, " as recorded")
        frame.compare("", "timestamp_ns", recorded.timestamp_ns, frame.tree.timestamp_ns, " as recorded")
        cloud = self._registration.register(self._preparation.prepared(recorded))
        check_values(frame, cloud)
        check_floors(frame, cloud)
        check_object_points(frame, cloud, recorded.calibration.depth)
        self.recomputed += len(frame.surfaces)


def _recorded(source: FrameSource, frame: ExportedFrame) -> RGBDFrame | None:
    """Read up to the frame of an export; return None if the recording does not contain it."""
    while True:
        try:
            recorded = source.read()
        except FrameFormatError:
            continue
        except EndOfRecordingError:
            return None
        if recorded.index >= frame.tree.frame:
            return recorded if recorded.index == frame.tree.frame else None
