"""Rate controller: lowers what a frame may cost until a wanted rate is held, and logs that."""

from __future__ import annotations

import logging
import statistics
from collections import deque

from nurbseg.segmentation.live.tree import Budget

_log = logging.getLogger(__name__)

#: Pixels by which the step of the grid may exceed the usual one; more saves nothing. The budget of revisions
#: stays: what is put off piles up until a frame is segmented from scratch, which costs more than was saved.
_COARSER = (0, 1, 2)
#: Coarsest grid, pixels.
_DECIMATION_MOST = 8
#: A frame may take this share of its period; below that share of it, more is tried.
_FULL, _SPARE = 0.8, 0.65
#: Frames of which the median is taken.
_FRAMES = 15
#: Frames between two changes: down, and up.
_DOWN_AFTER, _UP_AFTER = 8, 60
#: A try to do more has lasted after so many frames.
_LASTED = 600


class RateController:
    """Chooses the working resolution that holds a rate.

    Parameters
    ----------
    target_hz : float
        Wanted frames per second, over 0.
    decimation : int
        The usual step of the grid, pixels.

    Attributes
    ----------
    level : int
        What is given up: 0 for nothing.
    """

    def __init__(self, target_hz: float, decimation: int) -> None:
        if not target_hz > 0:
            raise ValueError(f"target_hz: expected more than 0, got {target_hz}")
        self.level = 0
        self._target_hz = target_hz
        self._period_ms = 1e3 / target_hz
        self._decimation = decimation
        self._took_ms: deque[float] = deque(maxlen=_FRAMES)
        self._since = 0
        self._patience = _UP_AFTER
        self._tried_more = False

    @property
    def budget(self) -> Budget:
        """What the next frame may cost."""
        return Budget(decimation=min(_DECIMATION_MOST, self._decimation + _COARSER[self.level]))

    def took(self, frame_ms: float, *, cold: bool = False) -> None:
        """Take note of what a frame cost.

        Parameters
        ----------
        frame_ms : float
            Time from taking the frame to its labels, milliseconds.
        cold : bool
            Whether it was segmented from scratch, which predicts nothing of those that follow.
        """
        self._since += 1
        if cold:
            return
        self._took_ms.append(frame_ms)
        if len(self._took_ms) < _DOWN_AFTER:
            return
        # The median: what a single frame takes longer, as the first one does, is no reason to change.
        usual_ms = statistics.median(self._took_ms)
        if usual_ms > _FULL * self._period_ms and self.level + 1 < len(_COARSER):
            if self._tried_more and self._since < _LASTED:
                # That failed: the next try waits longer.
                self._patience = min(2 * self._patience, 20 * _UP_AFTER)
            self._change(1, usual_ms)
        elif usual_ms < _SPARE * self._period_ms and self._since >= self._patience and self.level > 0:
            self._change(-1, usual_ms)
        elif self._tried_more and self._since >= _LASTED:
            self._patience = _UP_AFTER

    def _change(self, by: int, usual_ms: float) -> None:
        self.level += by
        self._tried_more = by < 0
        self._since = 0
        self._took_ms.clear()
        step = self.budget.decimation
        _log.info(
            "%s to hold %g frames/s (a frame took %.0f ms): every %s pixel",
            "doing less" if by > 0 else "doing more",
            self._target_hz,
            usual_ms,
            {1: "", 2: "2nd", 3: "3rd"}.get(step or 1, f"{step}th"),
        )
