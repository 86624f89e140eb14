"""A bounded queue between threads, with a policy for when it is full."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Generic, Literal, TypeVar

Item = TypeVar("Item")

#: The oldest item is dropped for the new one; the producer waits, and nothing is lost; or the new item is
#: refused, and nothing that was added is lost.
WhenFull = Literal["drop oldest", "wait", "refuse"]

#: Time between two looks whether the queue was closed, seconds.
_WAIT_S = 1.0
#: Notes that may wait; of more, the oldest are dropped.
_NOTES_MAX = 1000


class BoundedQueue(Generic[Item]):
    """A queue for items, and for notes (such as lines of a log) that take no room and are taken first.

    The sizes of the items that wait sum up to `capacity` at most; but an item always fits into an empty
    queue. Each counts one where no `size` is given. `when_full` says what happens to an item that does not
    fit; `dropped` counts those that were dropped or refused. A queue that is `closed` accepts nothing more.
    """

    def __init__(
        self, capacity: float, when_full: WhenFull, size: Callable[[Item], float] = lambda item: 1
    ) -> None:
        self.dropped = 0
        self.closed = False
        self._capacity, self._when_full, self._size = capacity, when_full, size
        self._filled = 0.0
        self._changed = threading.Condition()
        self._items: deque[Item] = deque()
        self._notes: deque[Item] = deque(maxlen=_NOTES_MAX)

    def put(self, item: Item, timeout_s: float | None = None) -> bool:
        """Add an item; return whether it was taken, which a closed queue does not do.

        A queue that lets its producer wait does so for `timeout_s` seconds at most and raises TimeoutError
        then; without it, until there is room or the queue is closed.
        """
        size = self._size(item)

        def fits() -> bool:
            return not self._items or self._filled + size <= self._capacity

        with self._changed:
            waits = self._when_full == "wait"
            if waits and not self._changed.wait_for(lambda: self.closed or fits(), timeout_s):
                raise TimeoutError(f"no room within {timeout_s:g} s")
            if self.closed:
                return False
            while not fits():
                self.dropped += 1
                if self._when_full == "refuse":
                    return False
                self._next_item()
            self._items.append(item)
            self._filled += size
            self._changed.notify_all()
            return True

    def put_urgent(self, note: Item) -> None:
        """Add a note; never waits, and drops the oldest of very many."""
        with self._changed:
            if not self.closed:
                self._notes.append(note)
                self._changed.notify_all()

    def take(self, timeout_s: float) -> Item | None:
        """Take the oldest note, or else the oldest item; None after the last one.

        Raises TimeoutError if nothing came in time.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._notes or self._items or self.closed, timeout_s):
                raise TimeoutError(f"nothing came within {timeout_s:g} s")
            self._changed.notify_all()
            if self._notes:
                return self._notes.popleft()
            return self._next_item() if self._items else None

    def __iter__(self) -> Iterator[Item]:
        """Yield what is put until the queue is closed and empty."""
        while not self.finished:
            with suppress(TimeoutError):
                if (item := self.take(_WAIT_S)) is not None:
                    yield item

    def close(self) -> None:
        """Accept nothing more; what waits can still be taken."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def discard(self) -> int:
        """Accept nothing more and forget what waits; return how many items that were."""
        with self._changed:
            count = len(self._items)
            self._items.clear()
            self._notes.clear()
            self.close()
            return count

    @property
    def finished(self) -> bool:
        """Whether it is closed and everything was taken."""
        with self._changed:
            return self.closed and not self._items and not self._notes

    def _next_item(self) -> Item:
        item = self._items.popleft()
        self._filled -= self._size(item)
        return item
