"""Pairs the depth and color messages of a recording by their stamps as they come."""

from collections import deque
from dataclasses import dataclass
from typing import Literal

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
        self._depth: deque[tuple[int, bytes]] = deque()
        self._color: deque[tuple[int, bytes]] = deque()
        self._labels: deque[tuple[int, bytes]] = deque()

    @property
    def waiting(self) -> int:
        """How many messages wait for their partners."""
        return len(self._depth) + len(self._color) + len(self._labels)

    def add(self, kind: Kind, stamp_ns: int, content: bytes) -> None:
        """Add a message."""
        waiting = {"depth": self._depth, "color": self._color, "labels": self._labels}[kind]
        waiting.append((stamp_ns, content))
        while len(waiting) > _WAITING_MAX or sum(len(each) for _, each in waiting) > _WAITING_BYTES_MAX:
            waiting.popleft()
            # A frame needs no labels.
            self.dropped += kind != "labels"

    def take(self, *, at_end: bool = False) -> StampedPair | None:
        """Return the next pair, or None while it is not certain; `at_end` says that nothing follows."""
        while self._depth and self._color:
            stamp_ns, depth = self._depth[0]
            place = min(range(len(self._color)), key=lambda n: abs(self._color[n][0] - stamp_ns))
            color_ns, color = self._color[place]
            gap_ns = abs(color_ns - stamp_ns)
            if gap_ns and not at_end and (self._color[-1][0] < stamp_ns or len(self._depth) < 2):
                # A nearer color image, or one for which this is the nearer, may follow.
                return None
            next_is_nearer = len(self._depth) > 1 and abs(color_ns - self._depth[1][0]) < gap_ns
            if gap_ns > self._limit_ns or next_is_nearer:
                self._depth.popleft()
                self.dropped += 1
                continue
            self._depth.popleft()
            for _ in range(place):
                self._color.popleft()
                self.dropped += 1
            self._color.popleft()
            return StampedPair(stamp_ns, depth, color, self._take_labels(stamp_ns))
        if at_end:
            self.dropped += len(self._depth) + len(self._color)
            self._depth.clear()
            self._color.clear()
        return None

    def _take_labels(self, stamp_ns: int) -> bytes | None:
        found = next((content for ns, content in self._labels if ns == stamp_ns), None)
        while self._labels and self._labels[0][0] <= stamp_ns:
            self._labels.popleft()
        return found
