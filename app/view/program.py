"""Shows and saves frames for another process; a program of its own.

Words come and go as pickled tuples, a frame's arrays through shared memory. It ends when it is told to, and
when the other process is gone: then with what it got until then.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import pickle
import signal
import sys
import threading
from multiprocessing.connection import Connection
from typing import Any

from nurbseg.app.view.memory import SharedSlots
from nurbseg.app.view.rerun import RerunView
from nurbseg.app.view.viewer import FILE_PATIENCE_S, ViewError

#: Time between two looks what became of the viewer, seconds.
_LOOK_S = 0.1
#: Of glibc's `mallopt`: how many heaps there are at most.
_M_ARENA_MAX = -8


class _Teller(logging.Handler):
    """Tells the other process something, from any thread; log records too."""

    def __init__(self, connection: Connection[Any, Any]) -> None:
        super().__init__()
        self._connection = connection
        self._sending = threading.Lock()

    def tell(self, *words: Any) -> None:
        with self._sending, contextlib.suppress(OSError):
            # Where nobody listens any more, reading says so too.
            self._connection.send(words)

    def emit(self, record: logging.LogRecord) -> None:
        self.tell("log", record.name, record.levelno, self.format(record))


def _follow(view: RerunView, slots: SharedSlots, words: Connection[Any, Any], teller: _Teller) -> float:
    """Do what comes until it is the end; return how long a file may take to be whole then, seconds."""
    told = (0, 0)
    while True:
        if (status := (view.dropped, view.connections)) != told:
            teller.tell("status", *status)
            told = status
        view.look_after()
        try:
            if not words.poll(_LOOK_S):
                continue
            word, *rest = words.recv()
        except (EOFError, OSError):
            return FILE_PATIENCE_S
        try:
            if word == "frame":
                slot, slot_bytes, sizes, body = rest
                slots.follow(slot_bytes)
                parts = slots.read(slot, sizes)
                teller.tell("free", slot)
                view.show(pickle.loads(body, buffers=parts))
            elif word == "line":
                view.show_line(*rest)
            else:
                return float(rest[0])
        except ViewError as err:
            teller.tell("failed", str(err))
        except Exception as err:
            teller.tell("failed", f"a frame cannot be shown ({type(err).__name__}): {err}")


def _share_one_heap() -> None:
    """Let all threads take memory from one heap: arrays pass between them, and each heap would grow."""
    with contextlib.suppress(OSError, AttributeError):  # Another C library has no such heaps.
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


def main() -> int:
    """Talk over the connection, and read the memory, whose descriptors are the two arguments."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # The other process ends this one. Not ignored, which a viewer that is started would inherit.
        signal.signal(number, lambda *_: None)
    _share_one_heap()
    words: Connection[Any, Any] = Connection(int(sys.argv[1]))
    slots = SharedSlots(int(sys.argv[2]))
    teller = _Teller(words)
    try:
        _, config, segmentation, properties, name, level = words.recv()
    except (EOFError, OSError):
        return 0
    logging.getLogger().addHandler(teller)
    logging.getLogger("nurbseg").setLevel(level)
    try:
        view = RerunView(config, segmentation, properties, name)
    except ViewError as err:
        teller.tell("refused", str(err))
        return 1
    teller.tell("opened", view.how_to_look, view.serving)
    limit_s = _follow(view, slots, words, teller)
    try:
        view.close(file_limit_s=limit_s)
    except ViewError as err:
        teller.tell("failed", str(err))
    teller.tell("status", view.dropped, view.connections)
    teller.tell("closed")
    return 0


if __name__ == "__main__":
    # Foreign threads that are stuck would keep the process from ending for good.
    os._exit(main())
