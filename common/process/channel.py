"""A connection between two processes: messages through a socket, frames through slots in shared memory."""

from __future__ import annotations

import contextlib
import io
import logging
import mmap
import os
import select
import socket
import sys
import threading
import time
from dataclasses import dataclass
from pickle import PickleBuffer
from typing import Any, Literal

from nurbseg.common.process.codec import decode, encode

#: Words of 8 bytes at the beginning of the memory: items put and taken so far, the last heartbeat
#: (`time.monotonic_ns`), and the number and size of the slots, which begin behind this page.
_PUT, _TAKEN, _BEAT, _SLOTS, _SLOT_BYTES = range(5)
_PAGE = mmap.PAGESIZE
#: Words at the beginning of a slot: the item's number and its size. The item follows.
_NUMBER, _SIZE, _HEAD_BYTES = 0, 1, 16
#: Message that wakes a process that waits for an item.
_WAKE = b"\0"
#: Largest message, bytes; what is larger goes through a slot.
_MESSAGE_BYTES = 100_000
#: A message that does not get through for this long is given up, seconds.
_STUCK_S = 15.0
#: Time between two looks whether there is room for an item, seconds.
_LOOK_S = 0.002

Items = Literal["next", "newest", "none"]


class ChannelClosedError(Exception):
    """The other process has closed its end, or has died."""


@dataclass(frozen=True, slots=True)
class _Logged:
    """A record of the other process's log."""

    name: str
    level: int
    text: str


class Channel:
    """Messages both ways, and items one way: large ones such as frames, in the slots of a ring.

    Any thread may send messages; one thread at a time receives. One thread of one of the two processes puts
    items, after it has called `begin_ring`. The connection (of type SOCK_SEQPACKET) and the descriptor
    `memory` of an unnamed file in memory are owned.
    """

    def __init__(self, connection: socket.socket, memory: int) -> None:
        self._connection, self._memory = connection, memory
        self._words = memoryview(mmap.mmap(memory, _PAGE)).cast("q")
        self._ring: memoryview | None = None
        self._puts = False
        #: Items that newer ones replaced before they were taken.
        self.skipped = 0
        self._received_ns = time.monotonic_ns()

    @property
    def silent_s(self) -> float:
        """How long nothing was received and no heartbeat came, seconds; 0 once it is closed."""
        if self._memory < 0:
            return 0.0
        return 1e-9 * (time.monotonic_ns() - max(self._received_ns, self._words[_BEAT]))

    def beat(self) -> None:
        """Leave a heartbeat; for a loop that calls this often."""
        self._words[_BEAT] = time.monotonic_ns()

    def send(self, message: Any, timeout_s: float = _STUCK_S) -> bool:
        """Send a message; return whether there was room for it within `timeout_s` seconds.

        Raises ChannelClosedError if nobody can receive it any more, and ValueError if it is too large.
        """
        encode(message, text := io.BytesIO())
        if text.tell() > _MESSAGE_BYTES:
            raise ValueError(f"a message of {text.tell()} bytes; at most {_MESSAGE_BYTES} can be sent")
        return self._send(text.getvalue(), timeout_s)

    def begin_ring(self, slots: int, slot_bytes: int) -> None:
        """Provide `slots` for items of up to `slot_bytes` bytes; they take memory once they are used."""
        slot_bytes = -(-(_HEAD_BYTES + slot_bytes) // _PAGE) * _PAGE
        self._puts = True
        os.ftruncate(self._memory, _PAGE + slots * slot_bytes)
        self._words[_SLOT_BYTES], self._words[_SLOTS] = slot_bytes, slots

    def put(self, item: Any, timeout_s: float = 0.0, *, overwrite: bool = False) -> bool:
        """Put an item; return whether there was room for it within `timeout_s` seconds.

        With `overwrite` there always is: it replaces the oldest one. Raises ChannelClosedError if nobody can
        take it any more, and ValueError if it is larger than a slot.
        """
        slots, put = self._words[_SLOTS], self._words[_PUT]
        deadline_s = time.monotonic() + timeout_s
        while not overwrite and put - self._words[_TAKEN] >= slots:
            if self._wait(_LOOK_S, select.POLLRDHUP):
                raise ChannelClosedError("the other process has ended")
            if time.monotonic() >= deadline_s:
                return False
        head, content = self._slot(put)
        head[_NUMBER] = -1
        encode(item, writer := _SlotWriter(content))
        head[_SIZE], head[_NUMBER] = writer.size, put
        self._words[_PUT] = put + 1
        if self._words[_TAKEN] >= put:
            # The other process may wait. If it has no room for this, it has a message to read.
            self._send(_WAKE, 0.0)
        return True

    def receive(self, timeout_s: float, items: Items = "next") -> Any | None:
        """Return the next message, or else an item: the next one, the newest, or none; None if none came.

        Raises ChannelClosedError if none can come any more.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            if self._memory < 0:
                raise ChannelClosedError("the connection is closed")
            text = self._received()
            if text:
                message = decode(text)
                if not isinstance(message, _Logged):
                    return message
                logging.getLogger(message.name).log(message.level, "%s", message.text)
                continue
            if items != "none" and (item := self.take(items)) is not None:
                return item
            if text is not None:
                raise ChannelClosedError("the other process has ended")
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                return None
            self._wait(left_s, select.POLLIN)

    def take(self, items: Items = "next", *, peek: bool = False) -> Any | None:
        """Return the next item or the newest, if there is one; with `peek`, it can be taken again."""
        if self._memory < 0 or self._puts:
            return None
        taken = self._words[_TAKEN]
        while True:
            put = self._words[_PUT]
            first = put - 1 if items == "newest" else put - self._words[_SLOTS]
            for number in range(max(taken, first), put):
                head, content = self._slot(number)
                # Unless it is being replaced.
                if head[_NUMBER] == number:
                    copy = bytes(content[: head[_SIZE]])
                    if head[_NUMBER] == number:
                        self._received_ns = time.monotonic_ns()
                        if not peek:
                            self.skipped += number - taken
                            self._words[_TAKEN] = number + 1
                        return decode(copy)
            if self._words[_PUT] == put:
                return None

    def close(self) -> None:
        """Release the connection and the memory; safe to call twice."""
        if self._memory >= 0:
            self._connection.close()
            self._words.release()
            if self._ring is not None:
                self._ring.release()
            os.close(self._memory)
            self._memory = -1

    def _send(self, text: bytes, timeout_s: float) -> bool:
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                self._connection.send(text, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
                return True
            except BlockingIOError:
                if time.monotonic() >= deadline_s:
                    return False
                time.sleep(_LOOK_S)
            except (OSError, ValueError) as err:
                raise ChannelClosedError("the other process has ended") from err

    def _received(self) -> bytes | None:
        """Return a message's bytes; None if there is none, and empty if none can come."""
        while True:
            try:
                text = self._connection.recv(2 * _MESSAGE_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return None
            except ConnectionResetError:
                continue  # what it had sent before comes first
            except (OSError, ValueError):
                return b""
            if text:
                self._received_ns = time.monotonic_ns()
            if text != _WAKE:
                return text

    def _slot(self, number: int) -> tuple[memoryview, memoryview]:
        """Return the head of the slot for an item, as words, and what follows it."""
        slots, slot_bytes = self._words[_SLOTS], self._words[_SLOT_BYTES]
        if self._ring is None:
            self._ring = memoryview(mmap.mmap(self._memory, _PAGE + slots * slot_bytes))
        begin = _PAGE + number % slots * slot_bytes
        slot = self._ring[begin : begin + slot_bytes]
        return slot[:_HEAD_BYTES].cast("q"), slot[_HEAD_BYTES:]

    def _wait(self, timeout_s: float | None, event: int) -> bool:
        """Wait for an event of the connection; return whether it came."""
        poll = select.poll()
        poll.register(self._connection, event)
        return bool(poll.poll(None if timeout_s is None else 1e3 * timeout_s))

    def end_with_parent(self, limit_s: float) -> None:
        """End this process where it goes on for longer than the limit after the other one has ended."""
        self._wait(None, select.POLLRDHUP)
        time.sleep(limit_s)
        os._exit(1)


class _SlotWriter:
    """Writes an item into a slot; raises ValueError beyond its end."""

    def __init__(self, slot: memoryview) -> None:
        self._slot, self.size = slot, 0

    def write(self, part: bytes | memoryview | PickleBuffer) -> None:
        raw = part.raw() if isinstance(part, PickleBuffer) else memoryview(part)
        begin, self.size = self.size, self.size + raw.nbytes
        if self.size > len(self._slot):
            raise ValueError(f"it does not fit into the {len(self._slot)} bytes for a frame")
        self._slot[begin : self.size] = raw


class _LogForwarder(logging.Handler):
    """Has the log of this process written by the other one."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        """Forward a record; waits a second at most."""
        logged = _Logged(record.name, record.levelno, self.format(record)[: _MESSAGE_BYTES // 8])
        with contextlib.suppress(ChannelClosedError):
            self._channel.send(logged, 1.0)


def forward_log(channel: Channel, level: int) -> None:
    """Have the log of this process written by the other one, what this package logs from a level on."""
    logging.getLogger().addHandler(_LogForwarder(channel))
    logging.getLogger("nurbseg").setLevel(level)


def connect_to_parent(*, limit_s: float) -> Channel:
    """Return the channel to the process that started this one; for programs that `ChildProcess` runs.

    When that process has finished or died, the channel raises ChannelClosedError, and this process should
    end. Where it hangs instead for longer than the limit, it is ended.
    """
    connection, memory = map(int, sys.argv[1:3])
    channel = Channel(socket.socket(fileno=connection), memory)
    # A daemon: it ends with the process, or ends it.
    threading.Thread(target=channel.end_with_parent, args=(limit_s,), name="parent", daemon=True).start()
    return channel
