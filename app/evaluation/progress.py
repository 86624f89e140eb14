"""How far a long command has come, for whoever watches."""

from __future__ import annotations

import sys


class Progress:
    """One line on stderr that grows, where somebody watches; silent in a file."""

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._shown = sys.stderr.isatty()

    def __call__(self, done: int, total: int, more: str = "") -> None:
        """Draw the line again."""
        if not self._shown:
            return
        filled = round(30 * done / max(total, 1))
        bar = "#" * filled + "." * (30 - filled)
        end = "\n" if done == total else ""
        print(f"\r[{bar}] {done}/{total} {self._unit} {more}", end=end, file=sys.stderr, flush=True)
