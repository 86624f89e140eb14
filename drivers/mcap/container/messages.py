"""The messages of a recording by topic, whatever file they are in."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

from nurbseg.common.closing import Closing
from nurbseg.common.errors import FrameFormatError
from nurbseg.common.limits import CHUNK_BYTES_MAX

#: A topic whose log times go back by more was recorded while the clock was set back, nanoseconds.
_SET_BACK_NS = 100_000_000
#: No message begins so: its first byte is 0.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class Topic(NamedTuple):
    """A topic: the name of its messages' schema, their encoding, and how many there are."""

    schema: str
    encoding: str
    messages: int


class Stored(NamedTuple):
    """A message of a topic: its place, which orders all messages of a file, when it was logged, its content.

    Where it is damaged, the content is the error, and the time that of nothing.
    """

    place: Any
    log_ns: int
    content: bytes | FrameFormatError


class _Position(NamedTuple):
    """Where a topic goes on: after which place, the last log time, and by how much later it counts."""

    after: Any = None
    last_ns: int = 0
    offset_ns: int = 0


class Logged(NamedTuple):
    """A message, when it was logged (nanoseconds), and what `Messages.messages` takes to go on after it."""

    topic: str
    log_ns: int
    content: bytes
    after: Any


def decompressed(content: bytes, compression: str, size: int) -> bytes:
    """Return the decompressed content, of which at most `size` + 1 bytes are made.

    Raises ValueError, or what the decompressor raises, if it is damaged or states that it is larger.
    """
    if compression == "lz4":
        import lz4.frame  # late, as zstandard

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size + 1))
    if compression == "zstd":
        import zstandard

        # The library allocates the size that the frame states.
        if (stated := zstandard.frame_content_size(content)) > size:
            raise ValueError(f"{size} bytes are declared, {stated} are there")
        return zstandard.ZstdDecompressor().decompress(content, max_output_size=max(1, size))
    if compression:
        raise ValueError(f"compression: expected zstd, lz4 or none, got {compression!r}")
    return content


def whole_message(content: bytes) -> bytes:
    """Return a message that ``ros2 bag`` may have compressed by itself; raises what `decompressed` does."""
    return decompressed(content, "zstd" if content.startswith(_ZSTD_MAGIC) else "", CHUNK_BYTES_MAX)


class Messages(Closing):
    """The messages of a recording, opened for reading.

    Attributes
    ----------
    path : Path
        The file, or the folder of a split bag.
    form : str
        What it is, for a person.
    profile : str
        What its messages follow, such as "ros2".
    whole : bool
        Whether it reaches its end.
    metadata : dict of str to dict
        Named texts.
    topics : dict of str to Topic
        Those that have messages.
    span_ns : int
        From the first to the last log time, nanoseconds; 0 if unknown.
    damage : str
        What is wrong with a part that was read to open the file.
    """

    form: str

    def __init__(self, path: Path) -> None:
        self.path, self.profile, self.whole, self.span_ns = path, "ros2", True, 0
        self.damage = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.topics: dict[str, Topic] = {}

    @abstractmethod
    def messages(self, topics: Iterable[str], after: Any = None) -> Iterator[Logged | FrameFormatError]:
        """Yield the messages of some topics, those after a `Logged.after`; what is damaged is one error.

        Those of one topic keep the file's order. Those of several come in the order in which they were
        logged, wherever the file has them: a converter may write topic by topic. Raises
        RecordingFormatError if the file cannot be read any more.
        """


class MessageFile(Messages):
    """One file of messages, which are found by topic.

    With `in_order`, all come in the file's order: they were written as they happened.
    """

    in_order = False

    def messages(self, topics: Iterable[str], after: Any = None) -> Iterator[Logged | FrameFormatError]:
        """Yield the messages of some topics."""
        positions: dict[str, _Position] = dict(after or {})
        complained: set[str] = set()
        each_topic = [self._timed(topic, positions.get(topic, _Position())) for topic in topics]
        # Equal times are in the file's order.
        for _, item, position, topic in merge(*each_topic, key=lambda each: (each[0], each[1].place)):
            content = item.content
            if isinstance(content, bytes):
                positions[topic] = position
                yield Logged(topic, item.log_ns, content, dict(positions))
            elif str(content) not in complained:
                complained.add(str(content))
                yield content

    def _timed(self, topic: str, start: _Position) -> Iterator[tuple[int, Stored, _Position, str]]:
        """Yield a topic's messages with times to merge them by, which go on where the clock was set back."""
        after, last_ns, offset_ns = start
        for item in self._of_topic(topic, after):
            if isinstance(item.content, bytes):
                if item.log_ns < last_ns - _SET_BACK_NS:
                    offset_ns += last_ns - item.log_ns
                last_ns = item.log_ns
            time_ns = 0 if self.in_order else last_ns + offset_ns
            yield time_ns, item, _Position(item.place, last_ns, offset_ns), topic

    @abstractmethod
    def _of_topic(self, topic: str, after: Any) -> Iterator[Stored]:
        """Yield the messages of a topic, in the file's order, after a place or from the first on."""
