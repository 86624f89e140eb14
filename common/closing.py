"""Objects that are open until they are closed."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self


class Closing(ABC):
    """An object that is open from its construction until `close`, and can be used in a ``with`` statement."""

    @abstractmethod
    def close(self) -> None:
        """Release what is held."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def closed_on_error(close: Callable[[], None]) -> Iterator[None]:
    """Call `close` if anything, Ctrl-C included, ends the block early."""
    try:
        yield
    except BaseException:
        close()
        raise
