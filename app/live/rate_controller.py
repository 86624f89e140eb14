"""Rate controller: lowers what a frame may cost until a wanted rate is held, and logs that."""

from __future__ import annotations

import logging
import statistics
from collections import deque

from nurbseg.segmentation.live.updater import Budget

_log = logging.getLogger(__name__)

#: Pixels by which the step of the grid may exceed the usual one; more saves nothing. The budget of revisions
#: stays: what is put off piles up until a frame is segmented from scratch, which costs more than was saved.
_COARSER = (0, 1, 2)
#: Share of its period beyond which a frame costs too much, and below which it has to stay on a finer grid.
_FULL, _SPARE = 0.9, 0.8
#: Share of its period beyond which the first frames are reason enough, slow as they are.
_HOPELESS = 1.25
#: Frames of which the median is taken.
_FRAMES = 30
#: Frames between two changes: down, and up.
_DOWN_AFTER, _UP_AFTER = 8, 60
#: Frames after which a finer grid is tried whatever it cost before.
_FORGET_AFTER = 3600


class RateController:
    """Chooses the working resolution that holds a rate; its `level` is what is given up, 0 for nothing."""

    def __init__(self, target_hz: float) -> None:
        if not target_hz > 0:
            raise ValueError(f"target_hz: expected more than 0, got {target_hz}")
        self.level = 0
        self._target_hz = target_hz
        self._took_ms: deque[float] = deque(maxlen=_FRAMES)
        self._since = 0
        # Before the last change, and how many times as much a frame costs on the next finer grid, by level.
        self._before_ms = 0.0
        self._was_finer: bool | None = None
        self._finer_costs = [1.0] * len(_COARSER)

    @property
    def budget(self) -> Budget:
        """What the next frame may cost."""
        return Budget(coarser=_COARSER[self.level])

    def took(self, frame_ms: float, *, source_hz: float = 0.0, cold: bool = False) -> None:
        """Take note of what a frame cost.

        Parameters
        ----------
        frame_ms : float
            Time from taking the frame to its labels, milliseconds.
        source_hz : float
            Rate of the source, beyond which there is nothing to gain; 0 where it is not known.
        cold : bool
            Whether it was segmented from scratch, which predicts nothing of those that follow.
        """
        self._since += 1
        if cold:
            return
        self._took_ms.append(frame_ms)
        if len(self._took_ms) < _DOWN_AFTER:
            return
        hz = min(self._target_hz, source_hz or self._target_hz)
        period_ms = 1e3 / hz
        # The median: nor is a single frame that takes longer.
        usual_ms = statistics.median(self._took_ms)
        full = len(self._took_ms) == _FRAMES
        # The first frames take longer: by a little, they are no reason to change.
        if not (full or self._before_ms or usual_ms > _HOPELESS * period_ms):
            return
        costs_too_much = usual_ms > _FULL * period_ms and self.level + 1 < len(_COARSER)
        if self._was_finer is not None and (full or costs_too_much):
            finer_ms, coarser_ms = sorted((usual_ms, self._before_ms), reverse=True)
            self._finer_costs[self.level + (not self._was_finer)] = finer_ms / coarser_ms
            self._was_finer = None
        if costs_too_much:
            self._change(1, usual_ms, hz)
        elif self.level > 0 and self._since >= _UP_AFTER:
            known = self._since < _FORGET_AFTER
            finer_ms = usual_ms * (self._finer_costs[self.level] if known else 1.0)
            if finer_ms < _SPARE * period_ms:
                self._change(-1, usual_ms, hz)

    def _change(self, by: int, usual_ms: float, hz: float) -> None:
        self.level += by
        self._was_finer = by > 0
        self._since = 0
        self._before_ms = usual_ms
        self._took_ms.clear()
        _log.info(
            "%s to hold %.3g frames/s (a frame took %.0f ms): the grid's step is %s",
            "doing less" if by > 0 else "doing more",
            hz,
            usual_ms,
            f"{_COARSER[self.level]} px more than usual" if self.level else "as usual",
        )
