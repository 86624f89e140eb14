"""A connection between two processes: messages through a socket, frames through a ring of shared memory."""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import select
import socket
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any, Literal

from nurbseg.common.process.codec import decode, encode

#: Words of 8 bytes at the beginning of the memory: items put and taken so far, the last heartbeat
#: (`time.monotonic_ns`), and the number and size of the slots, which begin behind this page.
_PUT, _TAKEN, _BEAT, _SLOTS, _SLOT_BYTES = range(5)
_PAGE = mmap.PAGESIZE
#: Words at the beginning of a slot: the item's number, how many parts it has, and the size of each.
_NUMBER, _PARTS, _SIZES, _PARTS_MAX = 0, 1, 2, 254
_HEAD_BYTES, _ALIGNMENT = 8 * (_SIZES + _PARTS_MAX), 16
#: Largest message, bytes; what is larger goes through the ring.
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
    items, after it has called `begin_ring`. The connection (of type SOCK_SEQPACKET), the descriptor `memory`
    of an unnamed file in memory, and `woken`, an eventfd that is set by each item, are owned.
    """

    def __init__(self, connection: socket.socket, memory: int, woken: int) -> None:
        self._connection = connection
        self._memory, self._woken = memory, woken
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
        (text,) = encode(message)
        if len(text) > _MESSAGE_BYTES:
            raise ValueError(f"a message of {len(text)} bytes; at most {_MESSAGE_BYTES} can be sent")
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

    def begin_ring(self, slots: int, slot_bytes: int) -> None:
        """Provide `slots` for items of up to `slot_bytes` bytes; they take memory once they are used."""
        slot_bytes = _aligned(_HEAD_BYTES + slot_bytes, _PAGE)
        self._puts = True
        os.ftruncate(self._memory, _PAGE + slots * slot_bytes)
        self._words[_SLOT_BYTES], self._words[_SLOTS] = slot_bytes, slots

    def put(self, item: Any, timeout_s: float = 0.0, *, overwrite: bool = False) -> bool:
        """Put an item; return whether there was room for it within `timeout_s` seconds.

        With `overwrite` there always is: it replaces the oldest one. Raises ChannelClosedError if nobody can
        take it any more, and ValueError if it is larger than a slot.
        """
        parts = encode(item, parts_max=_PARTS_MAX)
        slots, put = self._words[_SLOTS], self._words[_PUT]
        deadline_s = time.monotonic() + timeout_s
        while not overwrite and put - self._words[_TAKEN] >= slots:
            if self._wait(_LOOK_S, select.POLLRDHUP):
                raise ChannelClosedError("the other process has ended")
            if time.monotonic() >= deadline_s:
                return False
        slot = self._slot(put)
        size = sum(_aligned(part.nbytes) for part in parts)
        if _HEAD_BYTES + size > len(slot):
            raise ValueError(f"{size} bytes do not fit into the memory for a frame")
        words = slot[:_HEAD_BYTES].cast("q")
        words[_NUMBER] = -1
        words[_PARTS] = len(parts)
        begin = _HEAD_BYTES
        for place, part in enumerate(parts, _SIZES):
            words[place] = part.nbytes
            slot[begin : begin + part.nbytes] = part
            begin += _aligned(part.nbytes)
        words[_NUMBER] = put
        self._words[_PUT] = put + 1
        os.eventfd_write(self._woken, 1)
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
            takes = items != "none" and not self._puts
            if takes and (item := self.take(items)) is not None:
                return item
            if text is not None:
                raise ChannelClosedError("the other process has ended")
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                return None
            self._wait(left_s, select.POLLIN, *([self._woken] if takes else []))

    def take(self, items: Items = "next", *, peek: bool = False) -> Any | None:
        """Return the next item or the newest, if there is one; with `peek`, it can be taken again."""
        if self._memory < 0:
            return None
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._woken)
        while (put := self._words[_PUT]) > (taken := self._words[_TAKEN]):
            number = put - 1 if items == "newest" else max(taken, put - self._words[_SLOTS])
            slot = self._slot(number)
            words = slot[:_HEAD_BYTES].cast("q")
            if words[_NUMBER] != number:
                continue  # it is being replaced
            sizes = words[_SIZES : _SIZES + words[_PARTS]].tolist()
            copy = memoryview(bytes(slot[_HEAD_BYTES : _HEAD_BYTES + sum(map(_aligned, sizes))]))
            if words[_NUMBER] != number:
                continue
            parts, begin = [], 0
            for size in sizes:
                parts.append(copy[begin : begin + size])
                begin += _aligned(size)
            self._received_ns = time.monotonic_ns()
            if not peek:
                self.skipped += number - taken
                self._words[_TAKEN] = number + 1
            return decode(parts[0], parts[1:])
        return None

    def finish(self) -> None:
        """Signal the other process to end, as nothing more is sent; what it sends can be received."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Release the connection and the memory; safe to call twice."""
        if self._memory >= 0:
            self._connection.close()
            self._words.release()
            if self._ring is not None:
                self._ring.release()
            os.close(self._memory)
            os.close(self._woken)
            self._memory = -1

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
            return text

    def _slot(self, number: int) -> memoryview:
        slots, slot_bytes = self._words[_SLOTS], self._words[_SLOT_BYTES]
        if self._ring is None:
            self._ring = memoryview(mmap.mmap(self._memory, _PAGE + slots * slot_bytes))
        begin = _PAGE + number % slots * slot_bytes
        return self._ring[begin : begin + slot_bytes]

    def _wait(self, timeout_s: float | None, event: int, *others: int) -> bool:
        """Wait for an event of the connection, or for other descriptors to be readable."""
        poll = select.poll()
        poll.register(self._connection, event)
        for other in others:
            poll.register(other, select.POLLIN)
        return bool(poll.poll(None if timeout_s is None else 1e3 * timeout_s))

    def end_with_parent(self, limit_s: float) -> None:
        """End this process where it goes on for longer than the limit after the other one has ended."""
        self._wait(None, select.POLLRDHUP)
        time.sleep(limit_s)
        os._exit(1)


class LogForwarder(logging.Handler):
    """Has the log of this process written by the other one."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel
        # The message alone, without the format of this log.
        self.setFormatter(logging.Formatter())

    def emit(self, record: logging.LogRecord) -> None:
        """Forward a record; waits a second at most."""
        logged = _Logged(record.name, record.levelno, self.format(record)[: _MESSAGE_BYTES // 8])
        with contextlib.suppress(ChannelClosedError):
            self._channel.send(logged, 1.0)


def connect_to_parent(*, limit_s: float) -> Channel:
    """Return the channel to the process that started this one; for programs that `ChildProcess` runs.

    When that process has finished or died, the channel raises ChannelClosedError, and this process should
    end. Where it hangs instead for longer than the limit, it is ended.
    """
    connection, memory, woken = map(int, sys.argv[1:4])
    channel = Channel(socket.socket(fileno=connection), memory, woken)
    # A daemon: it ends with the process, or ends it.
    threading.Thread(target=channel.end_with_parent, args=(limit_s,), name="parent", daemon=True).start()
    return channel


def _aligned(size: int, alignment: int = _ALIGNMENT) -> int:
    """Return a size rounded up, bytes."""
    return -(-size // alignment) * alignment
