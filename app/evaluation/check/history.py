"""Checks values and trials that a live tree keeps from earlier frames."""

from __future__ import annotations

from collections.abc import Iterator

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedTrial, Finding


class History:
    """Values and trials of the frames that were checked so far."""

    def __init__(self) -> None:
        #: Number of values and trials from frames that are not in the export.
        self.unchecked = 0
        self._values: dict[int, set[tuple[float | None, int]]] = {}
        self._trials: dict[int, set[ExportedTrial | None]] = {}

    def check(self, frame: ExportedFrame) -> Iterator[Finding]:
        """Check values and trials from earlier frames, and remember those of this frame."""
        for name, each in frame.segments.items():
            for field, number, known, found in (
                ("value", each.measured, self._values, (each.value, each.points)),
                ("trial", each.judged, self._trials, each.trial),
            ):
                if number == frame.tree.frame or found in known.get(number, ()):
                    continue
                if number > frame.tree.frame or number in known:
                    yield frame.wrong(name, field, f"one of frame {number}, as the file says", found)
                else:
                    self.unchecked += 1
        own = frame.segments.values()
        self._values[frame.tree.frame] = {
            (each.value, each.points) for each in own if each.measured == frame.tree.frame
        }
        self._trials[frame.tree.frame] = {each.trial for each in own if each.judged == frame.tree.frame}
