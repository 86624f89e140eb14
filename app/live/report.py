"""The report of a run: numbers of frames, times and memory."""

from __future__ import annotations

import logging
import resource
import time
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nurbseg.app.errors import ExportError
from nurbseg.app.recording.recorder import Recorder
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.app.view.view import View
from nurbseg.common.code_cache import cache_error
from nurbseg.common.computer import versions
from nurbseg.common.files import is_stream, write_json
from nurbseg.drivers.process.client import SourceProcess

if TYPE_CHECKING:
    from nurbseg.app.publish.publisher import Publisher
    from nurbseg.segmentation.live.identity import Event
    from nurbseg.segmentation.live.tree import UpdateReport

_log = logging.getLogger(__name__)

#: Counters of updates of the live tree.
_REVISED = ("trials", "splits", "appeared", "undone", "judged")


class RunReport:
    """Collects a run's statistics, and writes them as JSON.

    What the source says of itself is read when the report is written.
    """

    def __init__(
        self,
        config: AppConfig,
        uri: str,
        source: SourceProcess,
        recorder: Recorder | None = None,
        publisher: Publisher | None = None,
        view: View | None = None,
    ) -> None:
        #: Frames segmented, and those of them too old to be shown.
        self.segmented = self.late = 0
        #: Whether a command ended the run.
        self.quit = False
        self.view = view or View()
        self._recorder, self._publisher = recorder, publisher
        self._config = config
        self._uri, self._source = uri, source
        self._began = datetime.now(UTC)
        self._began_s = time.monotonic()
        self._first_s: float | None = None
        self._last_s = self._began_s
        self._stages_ms: dict[str, array[float]] = {}
        self._events: Counter[str] = Counter()
        self._resets: Counter[str] = Counter()
        self._revised: Counter[str] = Counter()
        self._oldest_split = self._waiting = self._objects = 0

    def add(
        self,
        elapsed_ms: Mapping[str, float],
        events: Sequence[Event] = (),
        update: UpdateReport | None = None,
        *,
        objects: int = 0,
    ) -> None:
        """Add a segmented frame: the time of each stage in milliseconds, and the number of its objects."""
        self._objects = objects
        self._events.update(event.kind for event in events)
        if update is not None:
            if update.reset:
                self._resets[update.reset] += 1
            self._revised.update({name: getattr(update, name) for name in _REVISED})
            self._oldest_split = max(self._oldest_split, update.oldest)
            self._waiting = max(self._waiting, update.waiting)
        self._last_s = time.monotonic()
        if self._first_s is None:
            self._first_s = self._last_s
        self.segmented += 1
        for stage, value in elapsed_ms.items():
            self._stages_ms.setdefault(stage, array("d")).append(value)

    @property
    def recorded_only(self) -> int:
        """Frames read but not segmented, in a run that only records."""
        return self._source.status.read if self._config.record.only else 0

    @property
    def frames_per_s(self) -> float:
        """Frames segmented per second between the first and the last; 0 if there are fewer than two."""
        if self._first_s is None or self.segmented < 2:
            return 0.0
        return (self.segmented - 1) / max(self._last_s - self._first_s, 1e-9)

    def summary(self) -> str:
        """Return numbers of frames in one line."""
        if self.recorded_only and not self.segmented:
            return f"{self.recorded_only} frame{'s' * (self.recorded_only != 1)} read"
        text = f"{self.segmented} frame{'s' * (self.segmented != 1)} segmented"
        text += f", {self.frames_per_s:.2f} frames/s" if self.segmented > 1 else ""
        text += f", {self._objects} object{'s' * (self._objects != 1)} in the last" if self._objects else ""
        others = (
            (self._source.replaced, "overwritten by newer ones"),
            (self._source.status.damaged, "damaged"),
            (self.late, "too late to be shown"),
            (self.view.dropped, "dropped by the slow viewer"),
        )
        listed = ", ".join(f"{count} {what}" for count, what in others if count)
        return f"{text}; {listed}" if listed else text

    def warn_of_missing(self) -> None:
        """Warn if a replay was too fast for results to be of every frame."""
        missing = self._source.replaced + (0 if self._config.shown.save is None else self.late)
        if self._config.keeps_results and missing and not self._source.live:
            text = "%d of %d frames are missing from the results: --speed %g is too fast; without it none are"
            _log.warning(text, missing, self._source.status.read, self._config.source.speed)

    def document(self, ended: str) -> dict[str, Any]:
        """Return the report; `ended` is the reason why the run ended."""
        from nurbseg.segmentation.live.question import SPLIT_FRAMES

        status, overwritten = self._source.status, self._source.replaced
        recordings = [] if self._recorder is None else self._recorder.figures()
        unfinished = status.read - self.segmented - self.recorded_only - overwritten
        first_s = None if self._first_s is None else round(self._first_s - self._began_s, 3)
        return {
            "ended": ended,
            "began": self._began.isoformat(timespec="milliseconds"),
            "seconds": round(time.monotonic() - self._began_s, 3),
            "source": {"opened": self._uri, **self._source.metadata},
            "frames": {
                "read": status.read,
                "segmented": self.segmented,
                "late": self.late,
                "recorded_only": self.recorded_only,
                "dropped": {
                    "overwritten_by_a_newer_frame": overwritten,
                    "damaged": status.damaged,
                    "without_a_partner": int(self._source.metadata.get("dropped", 0)),
                    "unfinished_at_the_end": unfinished,
                },
                "camera": dict(status.losses),
                "damaged_frames": list(status.damaged_frames),
            },
            "recording": recordings[-1] if recordings else None,
            "earlier_recordings": recordings[:-1],
            "publications": [] if self._publisher is None else self._publisher.figures,
            "frames_per_s": round(self.frames_per_s, 3),
            "first_result_after_s": first_s,
            "latency_ms": {stage: _percentiles(values) for stage, values in self._stages_ms.items()},
            "events": dict(sorted(self._events.items())),
            "segmented_anew": dict(sorted(self._resets.items())),
            "live_tree": {
                **self._revised,
                "oldest_split_frames": self._oldest_split,
                "oldest_split_frames_limit": SPLIT_FRAMES,
                "most_waiting": self._waiting,
            },
            "view_failure": self.view.failure,
            "peak_memory_mb": {
                "segmentation": round(peak_memory_mb(), 1),
                "view": round(self.view.peak_memory_mb(), 1),
            },
            "compiled_code": {"kept": not cache_error(), "reason": cache_error()},
            "configuration": asdict(self._config),
            "versions": versions(),
        }

    def write(self, ended: str = "") -> None:
        """Write the report if the configuration asks for it; raises ExportError if that fails.

        `ended` is the reason why the run ended, empty if it did not: then no pipe or device gets a report.
        """
        if self._config.export.report is None:
            return
        path = Path(self._config.export.report)
        if not ended and is_stream(path):
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, self.document(ended or "still running"))
        except OSError as err:
            raise ExportError(f"{path}: cannot be written: {err.strerror}") from err


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    levels = (50, 95, 99.9)
    found = np.percentile(np.asarray(values), levels)
    named = {f"p{level:g}": round(float(value), 3) for level, value in zip(levels, found, strict=True)}
    return {**named, "max": round(max(values), 3)}


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process, 10^6 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
