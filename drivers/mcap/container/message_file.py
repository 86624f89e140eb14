"""What the messages of a recording are read from, whatever kind of file it is."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from mcap.records import Channel, Message, Schema

if TYPE_CHECKING:
    from nurbseg.drivers.mcap.container.file import Run


class MessageFile(Protocol):
    """A file of ROS messages, opened for reading.

    `form` is what it is, for a person; `whole`, whether it reaches its end. Messages are found by entry and
    offset: with `has_chunks`, what is wrong with one of an entry is wrong with all. `damaged` says what is
    wrong with entries that cannot be gone through. Channels and schemas are all there after `find_messages`.
    """

    path: Path
    form: str
    profile: str
    whole: bool
    has_chunks: bool
    metadata: dict[str, dict[str, str]]
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    damaged: dict[int, str]

    def find_messages(self) -> None:
        """Find out where the messages are."""

    def runs(self, channel: int) -> "Iterator[Run]":
        """Yield the messages of a channel, entry by entry."""

    def message(self, entry: int, offset: int) -> Message:
        """Return a message; raises FrameFormatError if it cannot be read."""

    def close(self) -> None:
        """Close the file; safe to call twice."""
