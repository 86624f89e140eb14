"""The messages of a recording's topics, in the order in which they are replayed.

That is the order in which they were logged, wherever the files have them: a converter may write topic by
topic. Only where the log's clock was set back the files' order is kept, which then is the order of events.
"""

from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Message
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.common.limits import SCAN_BYTES_MAX
from nurbseg.drivers.mcap.container.bag import MessageFile
from nurbseg.drivers.mcap.container.file import DAMAGED
from nurbseg.drivers.mcap.ros_messages import stamp_ns

#: Parts of a topic that overlap in time by less are stored out of order, nanoseconds.
_SHUFFLED_NS = 500_000_000
#: A topic that goes back in time this often is, too, messages.
_SHUFFLED_RUN = 3


class Logged(NamedTuple):
    """A message, its channel and its number in the timeline."""

    number: int
    channel: Channel
    message: Message


class Timeline:
    """The messages of some topics of one or several files, of which each begins where the one before ends.

    With `in_order` the files' order is that of events: a camera's clock may have been reset. `note` says
    which order was chosen, where it is not that of both the log and the files. Raises RecordingFormatError
    if a file cannot be gone through.
    """

    def __init__(
        self, files: Sequence[MessageFile], topics: Collection[str], *, in_order: bool = False
    ) -> None:
        self.note = ""
        self._is_by_log = False
        self._files = files
        parts: list[tuple[Any, ...]] = []
        names = sorted(topics)
        unknown = np.array([DAMAGED], dtype=np.int64)
        for place, file in enumerate(files):
            for channel in file.channels.values():
                if channel.topic in topics:
                    name = names.index(channel.topic)
                    parts += [
                        (place, run.entry, run.times_ns, run.offsets, name) for run in file.runs(channel.id)
                    ]
            parts += [(place, damaged, unknown, unknown, -1) for damaged in file.damaged]
        # Each part has one file, entry and topic, and any number of messages.
        counts = [len(part[2]) for part in parts]
        of_file, entry, topic = (
            np.repeat(np.array([part[k] for part in parts], np.int64), counts) for k in (0, 1, 4)
        )
        times_ns, offset = (
            np.concatenate([np.zeros(0, np.int64), *(part[k] for part in parts)]) for k in (2, 3)
        )
        order = np.lexsort((offset, entry, of_file))
        of_file, entry, topic, times_ns, offset = (
            each[order] for each in (of_file, entry, topic, times_ns, offset)
        )
        # What stands for a damaged chunk is where the message before it is.
        for row in np.flatnonzero(topic < 0):
            times_ns[row] = times_ns[row - 1] if row else 0
        self._where = np.stack([of_file, entry, offset], axis=1)
        self._topic, self._names = topic, names
        chosen = np.arange(len(times_ns)) if in_order else self._chosen_order(times_ns)
        self._where, self._topic = self._where[chosen], topic[chosen]
        #: When each was logged, nanoseconds.
        self.times_ns = times_ns[chosen]

    def undelay(self, topic: str, delay_ns: int) -> None:
        """Read the messages of a topic as much earlier as they are logged late, nanoseconds."""
        if not self._is_by_log:
            return
        taken_ns = self.times_ns.copy()
        taken_ns[self._topic == self._names.index(topic)] -= delay_ns
        order = np.argsort(taken_ns, kind="stable")
        self._where, self._topic, self.times_ns = self._where[order], self._topic[order], self.times_ns[order]

    def __len__(self) -> int:
        return len(self._where)

    def numbers(self, topic: str) -> NDArray[np.int64]:
        """Return the numbers of a topic's messages, in their order."""
        found = topic in self._names and self._topic == self._names.index(topic)
        return np.flatnonzero(found).astype(np.int64)

    def messages(
        self, numbers: NDArray[np.int64] | None = None, *, first: int = 0
    ) -> Iterator[Logged | FrameFormatError]:
        """Yield the messages from the `first` on, or those of these numbers; an error for a damaged chunk."""
        complained: set[tuple[int, int]] = set()
        for number in range(first, len(self)) if numbers is None else numbers.tolist():
            of_file, entry, offset = self._where[number].tolist()
            if (of_file, entry) in complained:
                continue
            file = self._files[of_file]
            try:
                message = file.message(entry, offset)
                if message.channel_id not in file.channels:
                    continue
                yield Logged(number, file.channels[message.channel_id], message)
            except FrameFormatError as err:
                if file.has_chunks:
                    complained.add((of_file, entry))
                yield err

    def _chosen_order(self, times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        each_topic = [times_ns[self._topic == number] for number in range(len(self._names))]
        several = [times for times in each_topic if len(times) > 1]
        if several and not any(np.ptp(times) for times in several):
            return self._by_stamps(times_ns)
        back_ns = 0
        for times in several:
            back_ns = max(back_ns, -int(np.diff(times).min()))
            if _was_set_back(times):
                self.note = (
                    f"the log's times go back by {back_ns * 1e-9:.3f} s: they are read in the order "
                    "of the file"
                )
                return np.arange(len(times_ns))
        if back_ns:
            self.note = (
                f"the log's times go back by {back_ns * 1e-9:.3f} s: they are read in the order of time"
            )
        self._is_by_log = True
        return np.argsort(times_ns, kind="stable")

    def _by_stamps(self, times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Order messages by their stamps, where the writer did not say when they were logged."""
        left = SCAN_BYTES_MAX
        stamps_ns = times_ns.copy()
        for item in self.messages():
            if isinstance(item, FrameFormatError):
                continue
            left -= len(item.message.data)
            if left < 0:
                return np.arange(len(times_ns))
            if len(item.message.data) >= 12:
                stamps_ns[item.number] = stamp_ns(item.message.data)
        self.note = "all messages have one log time: they are read in the order of their stamps"
        by_topic = [stamps_ns[self._topic == number] for number in range(len(self._names))]
        if any(len(stamps) > 1 and _was_set_back(stamps) for stamps in by_topic):
            return np.arange(len(times_ns))
        return np.argsort(stamps_ns, kind="stable")


def _was_set_back(times_ns: NDArray[np.int64]) -> bool:
    """Whether times go back to what was before, rather than being those of messages out of order."""
    ends = np.flatnonzero(np.diff(times_ns) < 0)
    if not ends.size:
        return False
    starts_ns = times_ns[np.concatenate([[0], ends + 1])]
    ends_ns = times_ns[np.concatenate([ends, [len(times_ns) - 1]])]
    order = np.argsort(starts_ns)
    overlaps_ns = np.maximum.accumulate(ends_ns[order])[:-1] - starts_ns[order][1:]
    return bool(overlaps_ns.max() > _SHUFFLED_NS and len(times_ns) > _SHUFFLED_RUN * len(starts_ns))
