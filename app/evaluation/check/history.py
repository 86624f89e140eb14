"""Whether values and trials that belong to other frames are those that these frames told."""

from __future__ import annotations

from collections.abc import Iterator

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedTrial, Finding


class History:
    """What the frames so far told of themselves.

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
        """Hold what belongs to frames before against what they told, and remember what this one tells.

        Parameters
        ----------
        frame : ExportedFrame
            Comes after all frames that were checked before.

        Yields
        ------
        Finding
            Each value and trial of another frame that this frame did not have.
        """
        tree = frame.tree_file
        for name, each in frame.segments.items():
            for field, number, told, found in (
                ("value", each.measured, self._values, (each.value, each.points)),
                ("trial", each.judged, self._trials, each.trial),
            ):
                if number == frame.frame or found in told.get(number, ()):
                    continue
                if number > frame.frame or number in told:
                    expected = f"one of frame {number}, to which it is said to belong"
                    yield Finding(tree, name, field, expected, str(found))
                else:
                    self.unchecked += 1
        own = frame.segments.values()
        self._values[frame.frame] = {
            (each.value, each.points) for each in own if each.measured == frame.frame
        }
        self._trials[frame.frame] = {each.trial for each in own if each.judged == frame.frame}
