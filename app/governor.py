"""The governor: lowers what a frame may cost until a wanted rate is held, and says so."""

from __future__ import annotations

import logging
from dataclasses import replace

from nurbseg.segmentation.live import Budget

_log = logging.getLogger(__name__)

#: What is given up first, and last: budgets, and pixels between the places of the grid beyond the usual.
_EFFORTS: tuple[tuple[Budget, int], ...] = (
    (Budget(), 0),
    (Budget(refits=3), 0),
    (Budget(refits=2, trials=1, folds=0), 0),
    (Budget(refits=3, trials=1, folds=0), 1),
    (Budget(refits=2, trials=1, folds=0), 2),
    (Budget(refits=1, trials=1, folds=0), 4),
)
#: Weight of a frame in the mean time of frames.
_WEIGHT = 0.2
#: A frame may take this share of its period; below that share of it, more is tried.
_FULL, _SPARE = 0.95, 0.6
#: Frames between two changes: down, and up.
_DOWN_AFTER, _UP_AFTER = 5, 60


class Governor:
    """Chooses the revision budget and the working resolution that hold a rate.

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
        self._mean_ms: float | None = None
        self._since = 0
        self._patience = _UP_AFTER

    @property
    def budget(self) -> Budget:
        """What the next frame may cost."""
        budget, coarser = _EFFORTS[self.level]
        return replace(budget, decimation=min(8, self._decimation + coarser))

    def took(self, frame_ms: float, *, cold: bool = False) -> None:
        """Take note of what a frame cost.

        Parameters
        ----------
        frame_ms : float
            Time from taking the frame to its labels, milliseconds.
        cold : bool
            Whether it was segmented anew, which tells nothing of those that follow.
        """
        self._since += 1
        if cold:
            return
        mean = frame_ms if self._mean_ms is None else self._mean_ms
        self._mean_ms = mean + _WEIGHT * (frame_ms - mean)
        if (
            self._mean_ms > _FULL * self._period_ms
            and self._since >= _DOWN_AFTER
            and self.level + 1 < len(_EFFORTS)
        ):
            if self._since < _UP_AFTER:
                # The last try to do more failed soon: the next one waits longer.
                self._patience = min(2 * self._patience, 20 * _UP_AFTER)
            self._change(1)
        elif self._mean_ms < _SPARE * self._period_ms and self._since >= self._patience and self.level > 0:
            self._change(-1)

    def _change(self, by: int) -> None:
        self.level += by
        mean_ms, self._mean_ms, self._since = self._mean_ms or 0.0, None, 0
        budget = self.budget
        _log.info(
            "%s to hold %g frames/s (a frame took %.0f ms): every %s pixel, %d refits and %d trials a frame",
            "doing less" if by > 0 else "doing more",
            self._target_hz,
            mean_ms,
            {1: "", 2: "2nd", 3: "3rd"}.get(budget.decimation or 1, f"{budget.decimation}th"),
            budget.refits,
            budget.trials,
        )
