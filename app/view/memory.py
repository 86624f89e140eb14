"""Memory shared with the process that shows frames, divided into slots of one frame's arrays each."""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

#: Slots: one is filled while one is read.
SLOTS = 2
#: Slots grow by whole parts of this size, bytes.
_PART = 1 << 20


class SharedSlots:
    """Slots for bytes in memory that two processes share; they agree on who uses which.

    Parameters
    ----------
    descriptor : int
        An open file that lies in memory; borrowed.

    Attributes
    ----------
    slot_bytes : int
        Room in each slot.
    """

    def __init__(self, descriptor: int) -> None:
        self.slot_bytes = 0
        self._descriptor = descriptor
        self._slots = np.zeros((SLOTS, 0), dtype=np.uint8)

    def make_room(self, size: int) -> None:
        """Let each slot have room for so many bytes; for the process that writes, while no slot is used.

        Raises
        ------
        OSError
            If there is not so much memory.
        """
        slot_bytes = -(-size // _PART) * _PART
        os.ftruncate(self._descriptor, SLOTS * slot_bytes)
        self.follow(slot_bytes)

    def follow(self, slot_bytes: int) -> None:
        """Take over the size of the slots; for the process that reads."""
        if slot_bytes != self.slot_bytes:
            memory = mmap.mmap(self._descriptor, SLOTS * slot_bytes)
            self._slots = np.frombuffer(memory, np.uint8).reshape(SLOTS, slot_bytes)
            self.slot_bytes = slot_bytes

    def write(self, slot: int, parts: Sequence[memoryview]) -> None:
        """Copy parts into a slot, one after the other."""
        at = 0
        for part in parts:
            self._slots[slot, at : at + part.nbytes] = np.frombuffer(part, np.uint8)
            at += part.nbytes

    def read(self, slot: int, sizes: Sequence[int]) -> list[NDArray[np.uint8]]:
        """Return copies of the parts of these sizes."""
        ends = np.cumsum([0, *sizes])
        return [self._slots[slot, a:b].copy() for a, b in pairwise(ends)]


__all__ = ["SLOTS", "SharedSlots"]
