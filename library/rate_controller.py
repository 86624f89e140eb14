"""Rate controller: coarsens the grid until the target frame rate is reached."""

import logging
import statistics
from collections import deque
from dataclasses import replace
from itertools import islice

from nurbseg.segmentation.live.tree import Budget

_log = logging.getLogger(__name__)

#: Share of the frame period that a frame has waited for the one before if it is late, and what is updated in
#: it at most. With nothing, work piles up until a frame is segmented from scratch.
_LATE, _LATE_BUDGET = 0.15, Budget(trials=2, judged_pixels=13_000)
#: Share of the frame period above which the grid becomes coarser, and below which it may become finer.
_FULL, _SPARE = 0.9, 0.8
#: Share of the frame period above which even the first, slow frames make the grid coarser.
_HOPELESS = 1.25
#: Number of frames whose median time counts, and that must be slow for a change while the rate holds.
_FRAMES, _SUSTAINED = 30, 90
#: Number of frames between two changes: to a coarser and to a finer grid.
_DOWN_AFTER, _UP_AFTER = 8, 60
#: Number of frames after which a finer grid is tried regardless of its earlier cost.
_FORGET_AFTER = 3600


class RateController:
    """Chooses the step of the grid that maintains a frame rate.

    `level` is by how many pixels it exceeds the usual one, 0 or 1: two would save another 5 % of a frame, and
    cost .01 GTRC in clutter. `budget`, that of a frame on time, stays: postponed updates of the tree add up
    to a frame that is segmented from scratch, which costs more.
    """

    def __init__(self, target_hz: float, budget: Budget | None = None) -> None:
        if not target_hz > 0:
            raise ValueError(f"target_hz: expected more than 0, got {target_hz}")
        self.level = 0
        self._target_hz = target_hz
        self._budget = budget or Budget()
        self._late_budget = replace(_LATE_BUDGET, trials=min(_LATE_BUDGET.trials, self._budget.trials))
        self._took_ms: deque[float] = deque(maxlen=_SUSTAINED)
        self._since = 0
        # Time per frame before the last change, and the factor of the finer grid.
        self._before_ms, self._finer_costs = 0.0, 1.0
        self._is_compared = True

    def budget(self, waited_ms: float = 0.0) -> Budget:
        """Return the budget of the next frame, which has waited so long for the one before it.

        Less of a late frame is updated, so that the delay does not last.
        """
        late = waited_ms > _LATE * 1e3 / self._target_hz
        return replace(self._late_budget if late else self._budget, coarser=self.level)

    def took(self, frame_ms: float, *, source_hz: float = 0.0, cold: bool = False) -> None:
        """Consider the time from taking a frame to its labels.

        `source_hz` is the rate of the source, 0 if unknown, above which there is nothing to gain. A `cold`
        frame was segmented from scratch and predicts nothing.
        """
        self._since += 1
        if cold:
            return
        self._took_ms.append(frame_ms)
        if len(self._took_ms) < _DOWN_AFTER:
            return
        hz = min(self._target_hz, source_hz or self._target_hz)
        period_ms = 1e3 / hz
        # The median ignores single slow frames.
        usual_ms = statistics.median(islice(reversed(self._took_ms), _FRAMES))
        full = len(self._took_ms) >= _FRAMES
        # The first frames take a little longer, which is no reason to change.
        if not (full or self._before_ms or usual_ms > _HOPELESS * period_ms):
            return
        # A scene can be rich for a second; while the rate holds, only what lasts is a reason.
        lasts = len(self._took_ms) == _SUSTAINED and statistics.median(self._took_ms) > _FULL * period_ms
        limit = _FULL if lasts or not full else 1.0
        costs_too_much = usual_ms > limit * period_ms and not self.level
        if not self._is_compared and (full or costs_too_much):
            finer_ms, coarser_ms = sorted((usual_ms, self._before_ms), reverse=True)
            self._finer_costs = finer_ms / coarser_ms
            self._is_compared = True
        finer_ms = usual_ms * (self._finer_costs if self._since < _FORGET_AFTER else 1.0)
        if costs_too_much:
            self._change(1, usual_ms, hz)
        elif self.level and self._since >= _UP_AFTER and finer_ms < _SPARE * period_ms:
            self._change(0, usual_ms, hz)

    def _change(self, level: int, usual_ms: float, hz: float) -> None:
        self.level, self._since, self._before_ms, self._is_compared = level, 0, usual_ms, False
        self._took_ms.clear()
        _log.info(
            "%s to hold %.3g frames/s (a frame took %.0f ms): the grid's step is %s",
            "doing less" if level else "doing more",
            hz,
            usual_ms,
            "1 px more than usual" if level else "as usual",
        )
