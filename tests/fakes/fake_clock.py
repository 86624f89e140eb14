"""Time that passes only where somebody sleeps."""

from __future__ import annotations


class FakeClock:
    """Returns its time, seconds, when called; `slept_s` are the sleeps so far."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.slept_s: list[float] = []

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.slept_s.append(seconds)
        self.now_s += seconds
