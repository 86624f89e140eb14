"""Pairs the depth and color messages of a recording by their times as they come, and keeps those beside."""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

from nurbseg.common.limits import CHUNK_BYTES_MAX

Kind = Literal["depth", "color", "labels"]

#: Waiting messages of one kind, and their bytes, after which the oldest cannot find a partner any more.
_WAITING_MAX, _WAITING_BYTES_MAX = 64, CHUNK_BYTES_MAX
#: Depth images that wait for their labels, which a program makes of them and logs later.
_LATE_LABELS = 16
#: Messages beside the images that are kept of a topic: at 1000 Hz, those of two frames.
_BESIDE = 64


@dataclass(frozen=True, slots=True)
class StampedPair:
    """A depth message, the color message of the same moment and the labels, where there are any.

    `log_ns` is when the depth message was logged, nanoseconds.
    """

    time_ns: int
    depth: bytes
    color: bytes | None
    labels: bytes | None
    log_ns: int


class StampPairing:
    """Pairs messages as they are added; equal stamps are paired immediately.

    Without `color`, each depth message is a pair by itself. With `labels`, a pair waits a while for its own,
    which are those of the same stamp; `unused_labels` counts others.
    """

    def __init__(self, limit_ns: int, *, color: bool = True, labels: bool = False) -> None:
        self.dropped = self.unused_labels = 0
        self._limit_ns = limit_ns
        self._has_color, self._has_labels = color, labels
        self._waiting: dict[Kind, deque[tuple[int, bytes, int]]] = {each: deque() for each in get_args(Kind)}

    @property
    def waiting(self) -> int:
        """How many messages wait for their partners."""
        return sum(map(len, self._waiting.values()))

    def add(self, kind: Kind, time_ns: int, content: bytes, log_ns: int) -> None:
        """Add a message."""
        waiting = self._waiting[kind]
        waiting.append((time_ns, content, log_ns))
        while len(waiting) > _WAITING_MAX or sum(len(each) for _, each, _ in waiting) > _WAITING_BYTES_MAX:
            waiting.popleft()
            # A frame needs no labels.
            self.dropped += kind != "labels"
            self.unused_labels += kind == "labels"

    def take(self, *, at_end: bool = False) -> StampedPair | None:
        """Return the next pair, or None while it is not certain; `at_end` says that nothing follows."""
        depths, colors, labels = self._waiting.values()
        while depths and (colors or not self._has_color):
            time_ns = depths[0][0]
            if not self._has_color:
                return None if self._awaits_labels(time_ns) and not at_end else self._pair(None)
            place = min(range(len(colors)), key=lambda n: abs(colors[n][0] - time_ns))
            color_ns, color, _ = colors[place]
            gap_ns = abs(color_ns - time_ns)
            is_open = colors[-1][0] < time_ns or len(depths) < 2
            if gap_ns and is_open and not at_end and not self._went_back():
                # A nearer color image, or one for which this is the nearer, may follow.
                return None
            next_is_nearer = len(depths) > 1 and abs(color_ns - depths[1][0]) < gap_ns
            if gap_ns > self._limit_ns or next_is_nearer:
                depths.popleft()
                self.dropped += 1
                continue
            if self._awaits_labels(time_ns) and not at_end:
                return None
            self.dropped += place
            for _ in range(place + 1):
                colors.popleft()
            return self._pair(color)
        if at_end:
            self.dropped += len(depths) + len(colors)
            self.unused_labels += len(labels)
            for waiting in self._waiting.values():
                waiting.clear()
        return None

    def _awaits_labels(self, time_ns: int) -> bool:
        """Whether labels of a stamp may still follow, and there is room to wait for them."""
        depths, colors, labels = self._waiting.values()
        count, size = len(colors), sum(len(each) for waiting in (depths, colors) for _, each, _ in waiting)
        has_room = 2 * count < _WAITING_MAX and 2 * size < _WAITING_BYTES_MAX
        may_follow = self._has_labels and not (labels and labels[-1][0] >= time_ns)
        return may_follow and has_room and len(depths) <= _LATE_LABELS

    def _pair(self, color: bytes | None) -> StampedPair:
        time_ns, depth, log_ns = self._waiting["depth"].popleft()
        labels = self._waiting["labels"]
        own = next((content for ns, content, _ in labels if ns == time_ns), None)
        while labels and labels[0][0] <= time_ns:
            labels.popleft()
            self.unused_labels += 1
        self.unused_labels -= own is not None
        return StampedPair(time_ns, depth, color, own, log_ns)

    def _went_back(self) -> bool:
        """Whether time went back in what waits, so that nothing nearer follows what came before."""
        return any(
            later[0] < earlier[0] - self._limit_ns
            for kind in ("depth", "color")
            for earlier, later in pairwise(self._waiting[kind])
        )


class Beside:
    """The newest messages of the topics that are read beside the images, with log times in nanoseconds."""

    def __init__(self, topics: Iterable[str], newest: Mapping[str, tuple[int, bytes]]) -> None:
        self._kept: dict[str, deque[tuple[int, bytes]]] = {topic: deque(maxlen=_BESIDE) for topic in topics}
        for topic, item in newest.items():
            self._kept[topic].append(item)

    @property
    def newest(self) -> dict[str, tuple[int, bytes]]:
        """The last message of each topic that had one."""
        return {topic: kept[-1] for topic, kept in self._kept.items() if kept}

    def add(self, topic: str, log_ns: int, content: bytes) -> None:
        """Add a message."""
        self._kept[topic].append((log_ns, content))

    def near(self, topic: str | None, log_ns: int) -> bytes | None:
        """Return the message of a topic that was logged nearest to a time, if any; of two, the later."""
        kept = reversed(self._kept.get(topic or "", deque()))
        return min(kept, key=lambda item: abs(item[0] - log_ns), default=(0, None))[1]
