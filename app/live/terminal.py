"""The status line at the bottom of a terminal, below the log."""

import logging
import os
import threading
import unicodedata
from contextlib import suppress
from typing import Self, TextIO

_ERASE = "\r\x1b[K"


def in_foreground(descriptor: int) -> bool:
    """Whether this process may use a terminal: a background process would be stopped."""
    try:
        return os.tcgetpgrp(descriptor) == os.getpgrp()
    except OSError:
        return False


class StatusLine:
    """The last line of a terminal, `stream`; while it is open, the log is written above it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._text = ""
        self._is_drawn = False

    def __enter__(self) -> Self:
        self._handlers = [
            each
            for each in logging.getLogger().handlers
            if isinstance(each, logging.StreamHandler) and each.stream is self._stream
        ]
        for each in self._handlers:
            each.setStream(self)
        return self

    def __exit__(self, *_: object) -> None:
        for each in self._handlers:
            each.setStream(self._stream)
        self.show("")

    def show(self, text: str) -> None:
        """Replace the line, cut to the width of the terminal."""
        # The terminal may be gone.
        with self._lock, suppress(OSError):
            self._text = text
            self._draw()

    def write(self, text: str) -> None:
        """Write complete lines above."""
        with self._lock:
            self._draw(text)

    def flush(self) -> None:
        """Do nothing: `write` flushes."""

    def _draw(self, above: str = "") -> None:
        """Write everything at once, so that no other output comes in between."""
        ours = in_foreground(self._stream.fileno())
        erased = _ERASE if ours and self._is_drawn else ""
        # The cursor stays at the beginning of the line, so that a viewer's own output overwrites it.
        line = f"{cut(self._text, self._columns() - 1)}\r" if ours and self._text else ""
        self._is_drawn = bool(line)
        self._stream.write(f"{erased}{above}{line}")
        self._stream.flush()

    def _columns(self) -> int:
        try:
            # Some terminals return 0.
            return os.get_terminal_size(self._stream.fileno()).columns or 80
        except OSError:
            return 80


def cut(text: str, columns: int) -> str:
    """Return the beginning of a text that fits, with "?" for characters that cannot be printed."""
    kept = ""
    for character in text:
        is_wide = unicodedata.east_asian_width(character) in ("W", "F")
        columns -= 0 if unicodedata.combining(character) else 2 if is_wide else 1
        if columns < 0:
            break
        kept += character if character.isprintable() else "?"
    return kept
