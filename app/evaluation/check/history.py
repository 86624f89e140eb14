"""Whether values and trials that belong to other frames are those in the files of these frames."""

from __future__ import annotations

from collections.abc import Iterator

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedTrial, Finding


class History:
    """Values and trials of the frames that were checked so far.

    Attributes
    ----------
    unchecked : int
        Values and trials that belong to frames that are not in the export.
    """

    def __init__(self) -> None:
        self.unchecked = 0
        self._values: dict[int, set[tuple[float | None, int]]] = {}
        self._trials: dict[int, set[ExportedTrial | None]] = {}

    def check(self, frame: ExportedFrame) -> Iterator[Finding]:
        """Check what belongs to frames before, which were checked, and remember what belongs to this one."""
        tree = frame.tree_file
        for name, each in frame.segments.items():
            for field, number, known, found in (
                ("value", each.measured, self._values, (each.value, each.points)),
                ("trial", each.judged, self._trials, each.trial),
            ):
                if number == frame.number or found in known.get(number, ()):
                    continue
                if number > frame.number or number in known:
                    expected = f"one of frame {number}, to which it is said to belong"
                    yield Finding(tree, name, field, expected, str(found))
                else:
                    self.unchecked += 1
        own = frame.segments.values()
        self._values[frame.number] = {
            (each.value, each.points) for each in own if each.measured == frame.number
        }
        self._trials[frame.number] = {each.trial for each in own if each.judged == frame.number}
