"""Decides which of a recording's two clocks its images are paired by, and which gives the frames their times.

A message has a stamp, set by what took the image, and a time at which it was logged. Stamps are the better
ones as long as they make sense.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.limits import STAMP_END_NS
from nurbseg.drivers.mcap.pairing import Kind

Clock = Literal["stamp", "log"]

#: A stamp that differs from the log's time by this much more than usual is wrong, nanoseconds ...
_WRONG_NS = 10_000_000_000
#: ... unless as many in a row do: then the clock was set.
_WAS_SET = 3
#: Share of images that must have partners by their stamps, of those that have by the log's times.
_PAIRED_SHARE = 0.5
#: Clocks whose rates differ by more are not the same, and the one that is further from the usual rate of
#: cameras, by this factor, is wrong.
_RATE_MAX = 1.25
_IMPLAUSIBLE = 3.0
_USUAL_PERIOD_NS = 33_333_333


@dataclass(frozen=True, slots=True)
class Clocks:
    """What images are paired by and frames get their times from, and what is wrong with the other one."""

    pairs: Clock = "stamp"
    times: Clock = "stamp"
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        names = {"stamp": "stamps", "log": "log times"}
        chosen = f"paired by {names[self.pairs]}, timed by {names[self.times]}"
        return f"{chosen} ({'; '.join(self.reasons)})" if self.reasons else chosen

    @classmethod
    def choose(
        cls, depth: Sequence[tuple[int, int]], color: Sequence[tuple[int, int]], limit_ns: int
    ) -> Self:
        """Return the clocks for images of which the stamps and log times, nanoseconds, of some are given.

        `color` may be empty. Wrong stamps of single images are `StampRepair`'s.
        """
        depth_ns, color_ns = (np.array(each, dtype=np.int64).reshape(-1, 2) for each in (depth, color))
        usable = [each[_is_possible(each)] for each in (depth_ns, color_ns)]
        for name, images, good in zip(("depth", "color"), (depth_ns, color_ns), usable, strict=True):
            if len(images) and len(good) <= len(images) / 2:
                zero = "0" if not images[:, 0].any() else "0, or out of range"
                return cls("log", "log", (f"the stamps of {name} are {zero}",))
            if len(good) > 2 and np.count_nonzero(np.diff(good[:, 0])) < len(good) / 2:
                return cls("log", "log", (f"the stamps of {name} do not change",))
        pairs: Clock = "stamp"
        times: Clock = "stamp"
        reasons = []
        if len(usable[0]) and len(usable[1]):
            by_stamp, by_log = (_paired(usable[0][:, k], usable[1][:, k], limit_ns) for k in (0, 1))
            apart_ns = np.median(usable[1][:, 0] - usable[1][:, 1]) - np.median(
                usable[0][:, 0] - usable[0][:, 1]
            )
            if by_stamp < _PAIRED_SHARE * by_log and abs(apart_ns) > limit_ns:
                pairs = times = "log"
                reasons.append(f"depth and color have different clocks, {abs(apart_ns) * 1e-9:.3f} s apart")
        stamp_ns, log_ns = (_period(usable[0][:, k]) for k in (0, 1))
        if stamp_ns > 0 and log_ns > 0 and not 1 / _RATE_MAX < stamp_ns / log_ns < _RATE_MAX:
            rate = stamp_ns / log_ns
            slow, factor, fast = (
                ("log times", rate, "stamps") if rate > 1 else ("stamps", 1 / rate, "log times")
            )
            reasons.append(f"{fast} run {factor:.3g} times as fast as {slow}")
            unusual_by = abs(math.log(stamp_ns / _USUAL_PERIOD_NS)) - abs(math.log(log_ns / _USUAL_PERIOD_NS))
            if unusual_by > math.log(_IMPLAUSIBLE):
                times = "log"
        return cls(pairs, times, tuple(reasons))


def lateness(depth: Sequence[tuple[int, int]], color: Sequence[tuple[int, int]]) -> int:
    """Return by how much later than depth color is logged, nanoseconds; 0 if it is not known.

    Both are given as stamps and log times. A clock that is set while they are taken is set for both, so that
    what was logged at the same time is compared.
    """
    (depth_ns, depth_delays), (color_ns, color_delays) = _delays(depth), _delays(color)
    if not len(depth_ns) or not len(color_ns):
        return 0
    nearest = np.abs(depth_ns[:, None] - color_ns[None, :]).argmin(axis=1)
    return int(np.median(color_delays[nearest] - depth_delays))


@dataclass(slots=True)
class StampRepair:
    """Replaces single stamps that are wrong by what the log's times say, and counts them.

    `usual_ns` is by how much the log is usually later than the stamps, as far as it is known.
    """

    usual_ns: dict[Kind, int] = field(default_factory=dict)
    replaced: int = 0
    _unusual: dict[Kind, int] = field(default_factory=dict)

    @classmethod
    def learned(cls, found: Mapping[Kind, Sequence[tuple[int, int]]]) -> Self:
        """Return one that knows the delay at first, from stamps and log times of messages, nanoseconds."""
        usual_ns: dict[Kind, int] = {}
        for kind, images in found.items():
            delays_ns = _delays(images)[1]
            if len(delays_ns):
                # That of all of them would lie between two if the clock was set meanwhile.
                runs = (delays_ns[n : n + _WAS_SET] for n in range(len(delays_ns)))
                first = next((run for run in runs if np.ptp(run) <= _WRONG_NS), delays_ns)
                usual_ns[kind] = int(np.median(first))
        return cls(usual_ns)

    def stamp(self, kind: Kind, seconds: int, nanoseconds: int, log_ns: int) -> int:
        """Return the stamp of a message, of which the fields are given, or one in its place."""
        stamp_ns = seconds * 1_000_000_000 + nanoseconds
        usual_ns = self.usual_ns.get(kind, next(iter(self.usual_ns.values()), 0))
        possible = nanoseconds < 1_000_000_000 and 0 <= stamp_ns < STAMP_END_NS
        possible &= stamp_ns > 0 or stamp_ns == log_ns
        if possible and kind in self.usual_ns and abs(log_ns - stamp_ns - usual_ns) > _WRONG_NS:
            self._unusual[kind] = self._unusual.get(kind, 0) + 1
            possible = self._unusual[kind] >= _WAS_SET
        if not possible:
            self.replaced += 1
            return min(max(0, log_ns - usual_ns), STAMP_END_NS - 1)
        self._unusual[kind] = 0
        self.usual_ns[kind] = log_ns - stamp_ns
        return stamp_ns


def _is_possible(images: NDArray[np.int64]) -> NDArray[np.bool_]:
    stamps_ns, log_ns = images.T
    # A rendered scene begins at 0, by both clocks.
    return np.asarray(
        ((stamps_ns > 0) | (stamps_ns == log_ns)) & (stamps_ns >= 0) & (stamps_ns < STAMP_END_NS)
    )


def _delays(images: Sequence[tuple[int, int]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the log times of messages whose stamps are possible, and their delays, nanoseconds."""
    times_ns = np.array(images, dtype=np.int64).reshape(-1, 2)
    times_ns = times_ns[_is_possible(times_ns)]
    return times_ns[:, 1], times_ns[:, 1] - times_ns[:, 0]


def _paired(one_ns: NDArray[np.int64], other_ns: NDArray[np.int64], limit_ns: int) -> int:
    """Return how many of the times have one of the others within the limit."""
    gaps_ns = np.abs(one_ns[:, None] - other_ns[None, :]).min(axis=1)
    return int(np.count_nonzero(gaps_ns <= limit_ns))


def _period(times_ns: NDArray[np.int64]) -> float:
    """Return the mean time between two images, without jumps of the clock; 0 if unknown."""
    # The median would not do: some recorders log images in bursts.
    steps_ns = np.diff(times_ns)
    steps_ns = steps_ns[(steps_ns >= 0) & (steps_ns < _WRONG_NS)]
    return float(np.mean(steps_ns)) if steps_ns.size > 1 else 0.0
