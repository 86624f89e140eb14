"""A connection between two processes: messages through a socket, arrays through shared memory."""

from __future__ import annotations

import contextlib
import json
import logging
import mmap
import os
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from nurbseg.common.errors import DriverError
from nurbseg.common.process.codec import Answer, Call, Codec, aligned

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Kind of message, bytes of JSON that follow, slot of the arrays, and bytes in each slot.
_HEADER = struct.Struct("<BIIQ")
_MESSAGE, _FREE_SLOTS, _LOG_RECORD, _HEARTBEAT = range(4)
_NO_SLOT = 0xFFFFFFFF
#: Slots grow by whole parts of this size, bytes.
_PART = 1 << 20
#: A socket that takes nothing for this long in the middle of a message is given up, seconds.
_STUCK_S = 15.0
#: Time between two heartbeats, seconds.
_BEAT_S = 1.0
#: Longest wait for a call before looking again, seconds.
_CALL_S = 60.0


class ChannelClosedError(Exception):
    """The other process has closed its end, or has died."""


class Channel:
    """Sends and receives messages; one thread receives, any thread sends.

    Arrays lie in slots of memory that both processes share. Only one of the two may send any: it takes a free
    slot for a message, and the other gives it back as soon as it has copied what is in it. The number of
    slots limits how much is in transit.

    The connection and `memory`, the descriptor of a file that lies in memory and has no name, are owned. The
    codec is the same at both ends.
    """

    def __init__(self, connection: socket.socket, memory: int, slots: int, codec: Codec) -> None:
        connection.settimeout(_STUCK_S)
        self._connection = connection
        self._descriptor = memory
        self._codec = codec
        self._slots = slots
        self._slot_bytes = 0
        self._memory: mmap.mmap | None = None
        # The last one that came free is taken first, so that little of the memory is ever touched.
        self._free = list(range(slots))
        self._changed = threading.Condition()
        self._sending = threading.Lock()
        self._taken: list[int] = []
        self._buffer = bytearray()
        self._received_s = time.monotonic()
        self._beat_s = 0.0
        self._closed = False

    @property
    def silent_s(self) -> float:
        """How long nothing was received, seconds; what was sent but not received yet does not count."""
        return time.monotonic() - self._received_s

    def send(self, message: Any, timeout_s: float = _STUCK_S) -> bool:
        """Send a message; return whether there was room for it within `timeout_s` seconds.

        Slots for arrays come free in `receive`, called by another thread or between two tries. Raises
        ChannelClosedError if nobody can receive it any more, and OSError if there is no memory for arrays.
        """
        text, arrays = self._codec.encode(message)
        size = sum(aligned(array.nbytes) for array in arrays)
        if not size:
            return self._write(_MESSAGE, text, timeout_s)
        slot = self._free_slot(size, timeout_s)
        if slot is None:
            return False
        self._copy(arrays, slot * self._slot_bytes)
        if self._write(_MESSAGE, text, timeout_s, slot):
            return True
        self._release(slot)
        return False

    def beat(self) -> None:
        """Send a heartbeat if the last one is old enough; for a loop that calls this often. Never waits."""
        now_s = time.monotonic()
        if now_s - self._beat_s > _BEAT_S:
            self._beat_s = now_s
            self._write(_HEARTBEAT, b"", 0.0)

    def is_waiting(self) -> bool:
        """Whether a message, or the end, can be received without waiting."""
        return bool(self._buffer) or _is_ready(self._connection, select.POLLIN, 0.0)

    def receive(self, timeout_s: float) -> Any | None:
        """Return the next message; None if none came within `timeout_s` seconds, or something else did.

        Raises ChannelClosedError if none can come any more.
        """
        deadline_s = time.monotonic() + timeout_s
        header = self._buffered(_HEADER.size, deadline_s)
        if header is None:
            self._return_slots()
            return None
        kind, size, slot, slot_bytes = _HEADER.unpack_from(header)
        whole = self._buffered(_HEADER.size + size, deadline_s)
        if whole is None:
            return None
        text = bytes(whole[_HEADER.size : _HEADER.size + size])
        del self._buffer[: _HEADER.size + size]
        if kind == _MESSAGE:
            return self._decoded(text, slot, slot_bytes)
        if kind == _FREE_SLOTS:
            self._release(*json.loads(text))
        elif kind == _LOG_RECORD:
            name, level, words = json.loads(text)
            logging.getLogger(name).log(level, "%s", words)
        return None

    def call(self, function: str, *arguments: Any, limit_s: float) -> Any:
        """Return what a function of the other process returns, or raise the DriverError that it raises.

        Raises ChannelClosedError if the process ends before, and TimeoutError if there is no answer in time.
        """
        self.send(Call(function, arguments))
        deadline_s = time.monotonic() + limit_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            if isinstance(answer := self.receive(left_s), Answer):
                return answer.result()
        raise TimeoutError(f"no answer within {limit_s:g} s")

    def answer(self, call: Call, functions: Mapping[str, Callable[..., Any]]) -> None:
        """Send what a function returns or raises; of an iterator, each item and then None."""
        name = call.function
        try:
            value = functions[name](*call.arguments)
            for item in value if isinstance(value, Iterator) else ():
                while not self.send(Answer(name, item), 0.0):
                    # Until the other process has taken an item before.
                    self.receive(_BEAT_S)
            answer = Answer(name, None if isinstance(value, Iterator) else value)
        except DriverError as err:
            answer = Answer(name, error=type(err).__name__, text=str(err))
        self.send(answer)

    def serve(self, functions: Mapping[str, Callable[..., Any]]) -> None:
        """Answer calls until the other process ends."""
        with contextlib.suppress(ChannelClosedError):
            while True:
                if isinstance(call := self.receive(_CALL_S), Call):
                    self.answer(call, functions)

    def finish(self) -> None:
        """Signal the other process to end, as nothing more is sent; what it sends can be received."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Release the connection and the memory; safe to call twice."""
        if self._descriptor >= 0:
            self._mark_closed()
            self._connection.close()
            os.close(self._descriptor)
            self._descriptor = -1

    def _write(self, kind: int, text: bytes, timeout_s: float, slot: int = _NO_SLOT) -> bool:
        with self._sending:
            try:
                if not _is_ready(self._connection, select.POLLOUT, timeout_s):
                    return False
                self._connection.sendall(_HEADER.pack(kind, len(text), slot, self._slot_bytes) + text)
            except (OSError, ValueError) as err:
                raise ChannelClosedError("the other process has ended") from err
        return True

    def _buffered(self, size: int, deadline_s: float) -> bytearray | None:
        """Return what was received, once it has this size; None if that takes too long."""
        while len(self._buffer) < size:
            try:
                if not _is_ready(self._connection, select.POLLIN, max(0.0, deadline_s - time.monotonic())):
                    return None
                part = self._connection.recv(1 << 16)
            except (OSError, ValueError):
                part = b""
            if not part:
                self._mark_closed()
                raise ChannelClosedError("the other process has ended")
            self._received_s = time.monotonic()
            self._buffer += part
        return self._buffer

    def _free_slot(self, size: int, timeout_s: float) -> int | None:
        with self._changed:
            # For the first arrays, and for larger ones: all slots change their size together.
            wanted = 1 if size <= self._slot_bytes else self._slots
            if not self._changed.wait_for(lambda: self._closed or len(self._free) >= wanted, timeout_s):
                return None
            if self._closed:
                raise ChannelClosedError("the other process has ended")
            if size > self._slot_bytes:
                slot_bytes = -(-size // _PART) * _PART
                os.ftruncate(self._descriptor, self._slots * slot_bytes)
                self._map(slot_bytes)
            return self._free.pop()

    def _map(self, slot_bytes: int) -> mmap.mmap:
        if self._memory is None or slot_bytes != self._slot_bytes:
            self._memory = mmap.mmap(self._descriptor, self._slots * slot_bytes)
            self._slot_bytes = slot_bytes
        return self._memory

    def _copy(self, arrays: Iterable[NDArray[Any]], offset: int) -> None:
        assert self._memory is not None
        with memoryview(self._memory) as memory:
            for array in arrays:
                memory[offset : offset + array.nbytes] = array.data.cast("B")
                offset += aligned(array.nbytes)

    def _decoded(self, text: bytes, slot: int, slot_bytes: int) -> Any:
        if slot == _NO_SLOT:
            return self._codec.decode(text, memoryview(b""))
        with memoryview(self._map(slot_bytes)) as memory, memory[slot * slot_bytes :][:slot_bytes] as body:
            message = self._codec.decode(text, body)
        # Several at a time, since each message takes Python's lock once.
        self._taken.append(slot)
        if 8 * len(self._taken) >= self._slots:
            self._return_slots()
        return message

    def _return_slots(self) -> None:
        if self._taken:
            with contextlib.suppress(ChannelClosedError):  # which `receive` reports after the last message
                self._write(_FREE_SLOTS, json.dumps(self._taken).encode(), _STUCK_S)
            self._taken = []

    def _release(self, *slots: int) -> None:
        with self._changed:
            self._free.extend(slots)
            self._changed.notify_all()

    def _mark_closed(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class LogForwarder(logging.Handler):
    """Has the log of this process written by the other one."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel
        # The message alone, without the format of this log.
        self.setFormatter(logging.Formatter())

    def emit(self, record: logging.LogRecord) -> None:
        """Forward a record; never waits for long."""
        text = json.dumps([record.name, record.levelno, self.format(record)]).encode()
        with contextlib.suppress(ChannelClosedError):
            self._channel._write(_LOG_RECORD, text, _BEAT_S)


def connect_to_parent(codec: Codec, *, limit_s: float) -> Channel:
    """Return the channel to the process that started this one; for programs that `ChildProcess` runs.

    When that process has finished or died, the channel raises ChannelClosedError, and this process should
    end. Where it hangs instead for longer than the limit, it is ended.
    """
    descriptor, memory, slots = map(int, sys.argv[1:4])
    connection = socket.socket(fileno=descriptor)

    def end_with_parent() -> None:
        _is_ready(connection, select.POLLRDHUP, None)
        time.sleep(limit_s)
        os._exit(1)

    # A daemon: it ends with the process, or ends it.
    threading.Thread(target=end_with_parent, name="parent", daemon=True).start()
    return Channel(connection, memory, slots, codec)


def _is_ready(connection: socket.socket, event: int, timeout_s: float | None) -> bool:
    """Wait until a socket can be read or written, or is closed; return whether it is in time."""
    poll = select.poll()
    poll.register(connection, event)
    return bool(poll.poll(None if timeout_s is None else 1e3 * timeout_s))
