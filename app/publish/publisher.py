"""Hands results to whatever publishes them, in a thread of its own: a slow listener never slows a run."""

import logging
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence

from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import SegmentationConfig

_log = logging.getLogger(__name__)

#: Commands of listeners that wait; of more, the oldest are forgotten.
_COMMANDS_MAX = 100
#: Time between two looks whether the run has ended, seconds.
_TAKE_S = 1.0
#: Longest wait for listeners where no result may be left out, seconds.
_WAIT_S = 10.0
#: Longest wait for the thread at the end, seconds.
_END_S = 2.0


class PublishError(Exception):
    """Results cannot be published; the message names where and why."""


class Sink(ABC):
    """One way of publishing.

    Attributes
    ----------
    commands : deque of str
        What listeners ask of the run, such as ``ratio 0.9``.
    """

    def __init__(self) -> None:
        self.commands: deque[str] = deque(maxlen=_COMMANDS_MAX)

    @abstractmethod
    def publish(self, result: FrameResult) -> None:
        """Publish a frame; raises PublishError if nothing can be published any more."""

    def configured(self, config: SegmentationConfig) -> None:  # noqa: B027 (not every sink tells it)
        """Take note of the settings of the next frames."""

    @abstractmethod
    def close(self) -> None:
        """Release what it holds."""


class Publisher:
    """Publishes results. Of those that wait only the newest counts, unless none may be left out.

    Parameters
    ----------
    sinks : sequence of Sink
        Where results are published; they are closed with it.
    every : bool
        Whether each result is published, and a run waits for slow listeners, for ten seconds at most.

    Attributes
    ----------
    published : int
        Frames that were given to the sinks.
    """

    def __init__(self, sinks: Sequence[Sink], *, every: bool = False) -> None:
        self.published = 0
        self._sinks = list(sinks)
        self._queue: BoundedQueue[FrameResult] = BoundedQueue(1, "wait" if every else "drop oldest")
        self._thread = threading.Thread(target=self._run, name="publish", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames that newer ones overtook."""
        return self._queue.dropped

    def commands(self) -> Iterator[str]:
        """Yield what listeners asked of the run since the last call."""
        for sink in list(self._sinks):
            while sink.commands:
                yield sink.commands.popleft()

    def configured(self, config: SegmentationConfig) -> None:
        """Tell listeners of the settings of the next frames."""
        for sink in list(self._sinks):
            sink.configured(config)

    def publish(self, result: FrameResult) -> None:
        """Publish a result soon."""
        try:
            self._queue.put(result, _WAIT_S)
        except TimeoutError:
            _log.warning("a listener takes nothing: frame %d is not published", result.frame.index)

    def close(self) -> None:
        """Publish what waits, within two seconds, and end."""
        self._queue.close()
        self._thread.join(_END_S)
        if self._thread.is_alive():
            _log.warning("a listener takes nothing: the last results were not published")

    def _run(self) -> None:
        while True:
            try:
                result = self._queue.take(_TAKE_S)
            except TimeoutError:
                continue
            if result is None:
                break
            self.published += 1
            for sink in list(self._sinks):
                try:
                    sink.publish(result)
                except PublishError as err:
                    _log.warning("%s; it is not published to any more", err)
                    self._sinks.remove(sink)
                    sink.close()
        for sink in self._sinks:
            sink.close()
