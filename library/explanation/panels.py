"""Pictures of a step: where its parts are, and what one surface and several leave unexplained."""

import base64
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.library.explanation.steps import Step
from nurbseg.library.palette import label_color, residual_colors

RGB = tuple[int, int, int]
#: Colors of the two sides of a cut; further parts of a side are lighter.
SIDES: tuple[RGB, RGB] = ((255, 200, 48), (64, 150, 255))
_LIGHTER = (0.0, 0.45, 0.7, 0.25)
#: Width of a picture, pixels.
WIDTH = 560
#: Scales of residuals, millimeters; that of a step reaches the residuals of so many percent of its points.
_SCALES_MM, _PERCENT = (0.5, 1, 2, 3, 5, 10, 20, 30, 50, 100, 200, 300, 500, 1000), 95.0
#: Share of the image's width or height that a close-up shows, at least, and its margin around a segment.
_LEAST_SHARE, _MARGIN = 0.25, 0.12
#: Brightness outside the segment, of the photo inside it, and below residuals.
_OUTSIDE, _INSIDE, _BELOW = 0.3, 0.45, 0.22
#: Color of a segment without a surface, and of outlines.
_PLAIN, _LINE = (150, 155, 162), (245, 247, 250)
_JPEG_QUALITY = 88


@dataclass(frozen=True, slots=True, eq=False)
class Panels:
    """Three pictures of a step, (h, `WIDTH`, 3) uint8 RGB.

    `sides` is the frame with the parts in their colors; `whole` and `parts` are close-ups of the distances to
    one surface and to those of the parts; `largest_m`, meters, is full red.
    """

    sides: NDArray[np.uint8]
    whole: NDArray[np.uint8]
    parts: NDArray[np.uint8]
    largest_m: float


def part_colors(step: Step) -> list[RGB]:
    """Return the color of each part: that of its side of the cut, or else one of its own."""
    if step.kind in ("gap", "merge"):
        return [label_color(number) for number in range(1, len(step.parts) + 1)]
    seen, colors = [0, 0], []
    for part in step.parts:
        share = _LIGHTER[seen[part.side] % len(_LIGHTER)]
        red, green, blue = (round(value + share * (255 - value)) for value in SIDES[part.side])
        colors.append((red, green, blue))
        seen[part.side] += 1
    return colors


def panels(step: Step, color: NDArray[np.uint8], grid_step: int) -> Panels:
    """Draw a step in a frame's photo, (H, W, 3) RGB; splits are decided on every `grid_step`-th pixel."""
    shape = color.shape[:2]
    height = round(WIDTH * shape[0] / shape[1])
    inside, numbers = np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.uint8)
    _spread(inside, step.whole.fit.pixels, 1, grid_step)
    maps = []
    for parts in ((step.whole,), step.parts):
        residuals_m = np.full(shape, np.nan, dtype=np.float32)
        for part in parts:
            if part.fit.residuals_m.size:
                _spread(residuals_m, part.fit.pixels, part.fit.residuals_m, grid_step)
        maps.append(residuals_m)
    for number, part in enumerate(step.parts):
        # Beyond 255 parts colors repeat.
        _spread(numbers, part.fit.pixels, 1 + number % 255, grid_step)
    largest_m = _scale_m(maps[0] if np.isfinite(maps[0]).any() else maps[1])
    table = np.array([(0, 0, 0), *part_colors(step)[:255]], dtype=np.uint8)

    frame, close = (0, 0, *shape), _close_up(inside)
    base, within = _sized(color, frame, height), _sized(numbers, frame, height, smooth=False)
    tinted = cv2.addWeighted(base, _INSIDE, table[within], 1.0 - _INSIDE, 0.0)
    sides = np.where(within[..., np.newaxis] > 0, tinted, _gray(base, _OUTSIDE))
    _outline(sides, within)
    if close[3] - close[1] < 0.8 * shape[1]:
        top, left, bottom, right = (round(edge * WIDTH / shape[1]) for edge in close)
        cv2.rectangle(sides, (left, top), (right - 1, bottom - 1), _LINE, 1, cv2.LINE_AA)

    photo, drawn = _sized(color, close, height), []
    colored = [np.array([_PLAIN] * 2, dtype=np.uint8), table]
    for residuals_m, borders, flat in zip(maps, (inside, numbers), colored, strict=True):
        known = _sized(np.isfinite(residuals_m).astype(np.uint8), close, height, smooth=False)
        area = _sized(borders, close, height, smooth=False)
        packed = residual_colors(np.nan_to_num(residuals_m), largest_m)
        rgb = np.ascontiguousarray(packed.astype(">u4").view(np.uint8).reshape(*shape, 4)[..., :3])
        plain = cv2.addWeighted(_gray(photo, 1.0), 0.5, flat[area], 0.5, 0.0)
        below = np.where(area[..., np.newaxis] > 0, plain, _gray(photo, _BELOW))
        picture = np.where(known[..., np.newaxis] > 0, _sized(rgb, close, height), below)
        _outline(picture, area)
        drawn.append(picture)
    return Panels(sides, drawn[0], drawn[1], largest_m)


def data_uri(image: NDArray[np.uint8]) -> str:
    """Return an RGB image as a JPEG within a URI, for pages that need no other file."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def _sized(
    image: NDArray[np.uint8], window: tuple[int, int, int, int], height: int, *, smooth: bool = True
) -> NDArray[np.uint8]:
    """Return a window of an image in the size of a picture."""
    top, left, bottom, right = window
    way = cv2.INTER_AREA if right - left > WIDTH else cv2.INTER_LINEAR
    way = way if smooth else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image[top:bottom, left:right], (WIDTH, height), interpolation=way), np.uint8)


def _spread(image: NDArray[Any], pixels: NDArray[np.intp], values: Any, step: int) -> None:
    """Set the square of pixels that each grid pixel stands for."""
    rows, columns = np.divmod(pixels, image.shape[1])
    # Squares at the border are cut off.
    for down in range(step):
        for right in range(step):
            row = np.minimum(rows + down, image.shape[0] - 1)
            image[row, np.minimum(columns + right, image.shape[1] - 1)] = values


def _scale_m(residuals_m: NDArray[np.float32]) -> float:
    known = residuals_m[np.isfinite(residuals_m)]
    wanted_mm = 1e3 * float(np.percentile(known, _PERCENT)) if known.size else 0.0
    return 1e-3 * next((scale for scale in _SCALES_MM if scale >= wanted_mm), _SCALES_MM[-1])


def _close_up(inside: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Return a window around a segment, in the proportions of the image: top, left, bottom, right."""
    height, width = inside.shape
    left, top, wide, high = cv2.boundingRect(inside)
    share = min(1.0, max((1 + 2 * _MARGIN) * max(wide / width, high / height), _LEAST_SHARE))
    h, w = round(share * height), round(share * width)
    y = min(max(0, round(top + high / 2 - h / 2)), height - h)
    x = min(max(0, round(left + wide / 2 - w / 2)), width - w)
    return y, x, y + h, x + w


def _gray(rgb: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    gray = cv2.convertScaleAbs(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), alpha=share)
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


def _outline(picture: NDArray[np.uint8], numbers: NDArray[np.uint8]) -> None:
    """Draw the borders between different numbers, but not around single pixels without depth."""
    kernel = np.ones((3, 3), dtype=np.uint8)
    picture[cv2.morphologyEx(cv2.medianBlur(numbers, 5), cv2.MORPH_GRADIENT, kernel) > 0] = _LINE
