"""Shared memory for pairs of images, divided into slots."""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Ring:
    """Slots of one depth image and one color image each.

    Parameters
    ----------
    memory : mmap.mmap
        A whole number of slots; shared between two processes, which agree on who uses which slot.
    depth_size, color_size : (width, height)
        Of the images, pixels.
    """

    def __init__(self, memory: mmap.mmap, depth_size: tuple[int, int], color_size: tuple[int, int]) -> None:
        depth_bytes = depth_size[0] * depth_size[1] * 2
        slots = np.frombuffer(memory, np.uint8).reshape(-1, slot_bytes(depth_size, color_size))
        self._depth = slots[:, :depth_bytes].view(np.uint16).reshape(-1, depth_size[1], depth_size[0])
        self._color = slots[:, depth_bytes:].reshape(-1, color_size[1], color_size[0], 3)

    def put(self, slot: int, depth_mm: NDArray[np.uint16], color: NDArray[np.uint8]) -> None:
        """Copy a pair into a slot."""
        self._depth[slot] = depth_mm
        self._color[slot] = color

    def take(self, slot: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return a copy of the pair in a slot: depth (H, W) uint16 and color (H, W, 3) uint8."""
        return self._depth[slot].copy(), self._color[slot].copy()


def slot_bytes(depth_size: tuple[int, int], color_size: tuple[int, int]) -> int:
    """Return how many bytes one slot takes."""
    return depth_size[0] * depth_size[1] * 2 + color_size[0] * color_size[1] * 3
