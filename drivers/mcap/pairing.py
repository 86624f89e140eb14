"""Pairs the depth and color messages of a recording by their stamps as they come."""

from collections import deque
from dataclasses import dataclass
from typing import Literal, get_args

from nurbseg.drivers.limits import CHUNK_BYTES_MAX

Kind = Literal["depth", "color", "labels"]

#: Waiting messages of one kind, and their bytes, after which the oldest cannot find a partner any more.
_WAITING_MAX, _WAITING_BYTES_MAX = 64, CHUNK_BYTES_MAX


@dataclass(frozen=True, slots=True)
class StampedPair:
    """A depth message, the color message of the same moment and, where there is one, the labels."""

    stamp_ns: int
    depth: bytes
    color: bytes
    labels: bytes | None


class StampPairing:
    """Pairs messages as they are added; equal stamps are paired immediately."""

    def __init__(self, limit_ns: int) -> None:
        self.dropped = 0
        self._limit_ns = limit_ns
        self._waiting: dict[Kind, deque[tuple[int, bytes]]] = {each: deque() for each in get_args(Kind)}

    @property
    def waiting(self) -> int:
        """How many messages wait for their partners."""
        return sum(map(len, self._waiting.values()))

    def add(self, kind: Kind, stamp_ns: int, content: bytes) -> None:
        """Add a message."""
        waiting = self._waiting[kind]
        waiting.append((stamp_ns, content))
        while len(waiting) > _WAITING_MAX or sum(len(each) for _, each in waiting) > _WAITING_BYTES_MAX:
            waiting.popleft()
            # A frame needs no labels.
            self.dropped += kind != "labels"

    def take(self, *, at_end: bool = False) -> StampedPair | None:
        """Return the next pair, or None while it is not certain; `at_end` says that nothing follows."""
        depths, colors, labels = self._waiting.values()
        while depths and colors:
            stamp_ns, depth = depths[0]
            place = min(range(len(colors)), key=lambda n: abs(colors[n][0] - stamp_ns))
            color_ns, color = colors[place]
            gap_ns = abs(color_ns - stamp_ns)
            if gap_ns and not at_end and (colors[-1][0] < stamp_ns or len(depths) < 2):
                # A nearer color image, or one for which this is the nearer, may follow.
                return None
            next_is_nearer = len(depths) > 1 and abs(color_ns - depths[1][0]) < gap_ns
            depths.popleft()
            if gap_ns > self._limit_ns or next_is_nearer:
                self.dropped += 1
                continue
            self.dropped += place
            for _ in range(place + 1):
                colors.popleft()
            own = next((content for ns, content in labels if ns == stamp_ns), None)
            while labels and labels[0][0] <= stamp_ns:
                labels.popleft()
            return StampedPair(stamp_ns, depth, color, own)
        if at_end:
            self.dropped += len(depths) + len(colors)
            depths.clear()
            colors.clear()
        return None
