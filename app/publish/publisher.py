"""Hands results to whatever publishes them, in threads: a slow listener or disk never slows a run."""

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence

from nurbseg.app.errors import PublishError
from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import SegmentationConfig

_log = logging.getLogger(__name__)

#: Longest wait for listeners where no result may be left out, and for one at the end of a run, seconds.
_WAIT_S, _END_S = 10.0, 2.0


class Sink(ABC):
    """One way of publishing.

    Attributes
    ----------
    name : str
        What messages and reports call it.
    """

    name = "a listener"

    @abstractmethod
    def publish(self, result: FrameResult) -> None:
        """Publish a frame; raises PublishError if nothing can be published any more."""

    def configured(self, config: SegmentationConfig) -> None:  # noqa: B027 (not every sink tells it)
        """Take note of the settings of the next frames."""

    @abstractmethod
    def close(self) -> None:
        """Release what it holds."""


class Publisher:
    """Publishes results, each sink's in a thread of its own, so that one that is slow delays no other.

    Of the results that wait for a sink, only its newest ones count, unless none may be left out.

    Parameters
    ----------
    sinks : sequence of Sink
        Where results are published; they are closed with it.
    every : bool
        Whether each result is published, and a run waits for slow sinks, for ten seconds at most.
    """

    def __init__(self, sinks: Sequence[Sink], *, every: bool = False) -> None:
        self._outlets = [_Outlet(sink, every=every) for sink in sinks]

    @property
    def figures(self) -> list[dict[str, str | int]]:
        """For each sink its name, and how many results it was given and missed."""
        return [
            {"to": outlet.sink.name, "published": outlet.published, "dropped": outlet.dropped}
            for outlet in self._outlets
        ]

    @property
    def failure(self) -> str:
        """Why results are lost, if one could not be written, for another reason than that nobody reads it."""
        return next((outlet.failure for outlet in self._outlets if outlet.failure), "")

    def configured(self, config: SegmentationConfig) -> None:
        """Tell listeners of the settings of the next frames."""
        for outlet in self._outlets:
            if not outlet.ended:
                outlet.sink.configured(config)

    def publish(self, result: FrameResult) -> None:
        """Publish a result soon."""
        for outlet in self._outlets:
            outlet.put(result)

    def close(self) -> None:
        """Publish what waits, each sink within its limit, and end; may be called twice."""
        for outlet in self._outlets:
            outlet.queue.close()
        for outlet in self._outlets:
            outlet.close()


class _Outlet:
    """A sink, with the results that wait for it and the thread that hands them over."""

    def __init__(self, sink: Sink, *, every: bool) -> None:
        self.sink = sink
        self.published = 0
        self.failure = ""
        #: Results that were not taken, counted by the run, and that were taken in vain, by the sink's thread.
        self._refused = self._lost = 0
        #: Whether the sink is closed.
        self.ended = False
        self._closed = False
        self.queue: BoundedQueue[FrameResult] = BoundedQueue(1, "wait" if every else "drop oldest")
        self._thread = threading.Thread(target=self._run, name=f"publish {sink.name}", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Results that newer ones overtook, or that came after a failure."""
        return self.queue.dropped + self._refused + self._lost

    def put(self, result: FrameResult) -> None:
        try:
            taken = self.queue.put(result, _WAIT_S)
        except TimeoutError:
            self._refused += 1
            _log.warning("%s takes nothing: frame %d is not published", self.sink.name, result.frame.index)
        else:
            self._refused += not taken

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._thread.join(_END_S)
        if self._thread.is_alive():
            self._refused += self.queue.discard() + 1
            _log.warning("%s takes nothing: the last results were not published", self.sink.name)

    def _run(self) -> None:
        try:
            for result in self.queue:
                self.sink.publish(result)
                self.published += 1
        except PublishError as err:
            self._lost += 1
            if not isinstance(err.__cause__, BrokenPipeError):
                self.failure = str(err)
            _log.warning("%s; it is not published to any more", err)
        finally:
            self._lost += self.queue.discard()
            self.ended = True
            try:
                self.sink.close()
            except PublishError as err:
                _log.warning("%s", err)
