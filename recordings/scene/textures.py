"""Textures of the synthetic scene, drawn from noise and simple shapes."""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Color = tuple[int, int, int]

#: Height and width of a print, of a plain surface and of a ball's cover, pixels.
_PRINT_PX, _PLAIN_PX, _BALL_PX = 192, 96, 240


def wood(rng: np.random.Generator, height: int, width: int) -> NDArray[np.uint8]:
    """Return planks of oiled wood with their grain along the width, (height, width, 3) RGB."""
    planks = 6
    edges = np.linspace(0, height, planks + 1).astype(int)
    image = np.empty((height, width, 3), dtype=np.float32)
    for top, bottom in pairwise(edges):
        rows = bottom - top
        # Grain: noise drawn out along the plank, warped by slow noise so that the lines wander.
        grain = _noise(rng, rows, width, 2, width // 5)
        rings = np.sin(18 * _noise(rng, rows, width, max(rows // 3, 2), width // 3) + 3 * grain)
        shade = 1 + 0.06 * grain + 0.04 * rings + 0.06 * rng.standard_normal()
        image[top:bottom] = shade[..., None] * np.array([170, 128, 90], dtype=np.float32)
        image[top : top + 2] *= 0.72
    return _to_bytes(image)


def plaster(rng: np.random.Generator, height: int, width: int) -> NDArray[np.uint8]:
    """Return a painted wall with faint unevenness, (height, width, 3) RGB."""
    slow, fine = _noise(rng, height, width, height // 4, width // 6), _noise(rng, height, width, 2, 2)
    tone = 1 + 0.012 * slow + 0.005 * fine
    down = np.linspace(1.03, 0.96, height, dtype=np.float32)[:, None]
    return _to_bytes((tone * down)[..., None] * np.array([196, 200, 194], dtype=np.float32))


def printed(rng: np.random.Generator, base: Color, accent: Color) -> NDArray[np.uint8]:
    """Return a printed carton: a field, a band, a disc and lines of text, (H, W, 3) RGB."""
    size = _PRINT_PX
    image = np.full((size, size, 3), base, dtype=np.uint8)
    band = int(rng.uniform(0.16, 0.24) * size)
    cv2.rectangle(image, (0, band), (size, band + 34), accent, -1, cv2.LINE_AA)
    center = (int(rng.uniform(0.4, 0.6) * size), int(0.62 * size))
    cv2.circle(image, center, 34, (244, 238, 222), -1, cv2.LINE_AA)
    cv2.circle(image, center, 22, accent, -1, cv2.LINE_AA)
    for line in range(3):
        y = int((0.86 + 0.04 * line) * size)
        cv2.line(image, (int(0.12 * size), y), (int(rng.uniform(0.5, 0.88) * size), y), (60, 54, 50), 1)
    return image


def banded(rng: np.random.Generator, base: Color, accent: Color) -> NDArray[np.uint8]:
    """Return a can's wrapper: metal rims, a field, a wavy band, (H, W, 3) RGB."""
    size = _PRINT_PX
    image = np.full((size, size, 3), base, dtype=np.uint8)
    across = np.arange(size)
    middle = 0.5 * size + 0.05 * size * np.sin(4 * np.pi * across / size + rng.uniform(0, 6))
    rows = np.arange(size)[:, None]
    image[np.abs(rows - middle) < 0.16 * size] = accent
    image[np.abs(np.abs(rows - middle) - 0.19 * size) < 0.015 * size] = (240, 236, 226)
    rim = size // 24
    image[:rim], image[-rim:] = (206, 206, 202), (168, 168, 166)
    return image


def plain(rng: np.random.Generator, base: Color, *, grain: float = 0.03) -> NDArray[np.uint8]:
    """Return one color with a little unevenness, (H, W, 3) RGB."""
    tone = 1 + grain * _noise(rng, _PLAIN_PX, _PLAIN_PX, 3, 3)
    return _to_bytes(tone[..., None] * np.array(base, dtype=np.float32))


def striped(rng: np.random.Generator, base: Color, accent: Color) -> NDArray[np.uint8]:
    """Return stripes along the width, with the unevenness of cloth, (H, W, 3) RGB."""
    size = _PRINT_PX
    is_accent = np.arange(size) // (size // 12) % 3 == 0
    image = np.repeat(np.where(is_accent[:, None, None], accent, base), size, axis=1).astype(np.float32)
    return _to_bytes(image * (1 + 0.05 * _noise(rng, size, size, 1, 2))[..., None])


def beach_ball(colors: tuple[Color, ...]) -> NDArray[np.uint8]:
    """Return the sectors of a ball with a cap at either pole, (H, W, 3) RGB."""
    size = _BALL_PX
    sector = (np.arange(size) * len(colors) // size)[None, :].repeat(size, axis=0)
    image = np.array(colors, dtype=np.uint8)[sector]
    cap = size // 16
    image[:cap], image[-cap:] = (240, 238, 230), (240, 238, 230)
    return image


def _noise(
    rng: np.random.Generator, height: int, width: int, rows: float, columns: float
) -> NDArray[np.float32]:
    """Return noise of unit deviation, smooth over that many rows and columns."""
    small = (max(int(width / columns), 2) + 3, max(int(height / rows), 2) + 3)
    coarse = rng.standard_normal((small[1], small[0])).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def _to_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
