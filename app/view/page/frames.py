"""Frames for browsers: encoded once, kept for those that connect later, sent as Rerun's viewer reads them."""

import itertools
import logging
import struct
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import rerun as rr

from nurbseg.app.view.drawing.entities import FrameEntities
from nurbseg.app.view.stream import NewestSink, Opening, Writer
from nurbseg.app.view.viewer import untested_rerun

logger = logging.getLogger(__name__)

#: Where Rerun's viewer requests frames, and the type of the answer: gRPC-Web.
READ_MESSAGES = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
GRPC_WEB = "application/grpc-web+proto"
#: End of a gRPC-Web answer: a frame of trailers.
_TRAILERS = b"grpc-status:0\r\n"
END = struct.pack(">BI", 0x80, len(_TRAILERS)) + _TRAILERS
#: Rerun's encoding: a header of 12 bytes that begins with this, then messages behind their kind and length.
_MAGIC, _HEADER_BYTES, _MESSAGE_HEADER = b"RRF2", 12, struct.Struct("<QQ")
#: Kind of the last message of a stream.
_LAST = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """What one item adds to the stream; a frame can be left out of it."""

    number: int
    content: bytes
    is_frame: bool


class FrameStream(NewestSink):
    """Encodes the newest frames in a thread of its own and hands them to any number of browsers.

    A browser first gets the frames of before, within `memory_max` bytes; then, if it is slow, only the newest
    one. What holds at all times (layout, cameras, settings) is kept for the whole run.
    """

    def __init__(self, opening: Opening, memory_max: int) -> None:
        self._opening = opening
        self._memory_max = memory_max
        self._filled = self._number = 0
        self._lasting: list[_Part] = []
        self._passing: deque[_Part] = deque()
        self._ended = False
        self._changed = threading.Condition()
        super().__init__("view-page-frames")

    def finish_close(self, limit_s: float) -> None:
        """Give the encoder so many seconds to finish; the browsers' streams end then."""
        super().finish_close(limit_s)
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def parts(self, wait_s: float) -> Iterator[bytes]:
        """Yield what a new browser is sent until the run ends; ``b""`` after `wait_s` seconds of silence."""
        self.connections += 1
        seen = 0
        while True:
            with self._changed:
                self._changed.wait_for(partial(self._has_more, seen), wait_s)
                new = [*self._after(seen, self._lasting), *self._after(seen, self._passing)]
                ended = self._ended
            newest = max((part.number for part in new if part.is_frame), default=0)
            for part in sorted(new, key=lambda part: part.number):
                if seen == 0 or not part.is_frame or part.number == newest:
                    yield part.content
            seen = max((part.number for part in new), default=seen)
            if ended:
                return
            if not new:
                yield b""

    def _has_more(self, number: int) -> bool:
        return self._number > number or self._ended

    @staticmethod
    def _after(number: int, parts: list[_Part] | deque[_Part]) -> Iterator[_Part]:
        return itertools.takewhile(lambda part: part.number > number, reversed(parts))

    def _run(self) -> None:
        try:
            # Two streams of one recording: what holds at all times is kept longer than frames.
            lasting, passing = self._opening.stream(), self._opening.stream()
            encoded = rr.binary_stream(lasting), rr.binary_stream(passing)
            self._opening.send(lasting)
            writer = Writer(lasting)
            self._add(*(each.read() or b"" for each in encoded), is_frame=False)
            for item in self.queue:
                writer.write(passing, item)
                self._add(*(each.read() or b"" for each in encoded), is_frame=isinstance(item, FrameEntities))
        except Exception:
            logger.exception("nothing more will be shown in browsers%s", untested_rerun())

    def _add(self, lasting: bytes, passing: bytes, *, is_frame: bool) -> None:
        """Add messages: those that hold at all times, and those of a moment."""
        kept, frame = (
            b"".join(_framed(kind, message) for kind, message in _messages(encoded))
            for encoded in (lasting, passing)
        )
        with self._changed:
            self._number += 1
            if kept:
                self._lasting.append(_Part(self._number, kept, is_frame=False))
            if frame:
                self._passing.append(_Part(self._number, frame, is_frame))
                self._filled += len(frame)
            while self._filled > self._memory_max and len(self._passing) > 1:
                self._filled -= len(self._passing.popleft().content)
            self._changed.notify_all()


def _messages(encoded: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the messages of a stream that Rerun has encoded; raises ValueError if it is of another form."""
    if not encoded:
        return
    if encoded[:4] != _MAGIC:
        raise ValueError(f"expected a stream that begins with {_MAGIC!r}, got {encoded[:4]!r}")
    position = _HEADER_BYTES
    while position < len(encoded):
        kind, size = _MESSAGE_HEADER.unpack_from(encoded, position)
        if kind == _LAST:
            return
        position += _MESSAGE_HEADER.size
        yield kind, encoded[position : position + size]
        position += size


def _framed(kind: int, message: bytes) -> bytes:
    """Return a message as a gRPC-Web answer has it: in a LogMsg, whose field is its kind, in field 1."""
    content = _field(1, _field(kind, message))
    return struct.pack(">BI", 0, len(content)) + content


def _field(number: int, content: bytes) -> bytes:
    """Return a protobuf field of bytes."""
    size, encoded = len(content), bytearray([number << 3 | 2])
    while size > 0x7F:
        encoded.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes(encoded) + bytes([size]) + content
