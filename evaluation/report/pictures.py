"""Pictures of frames and segmentations as PNG and JPEG."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.library.palette import label_color

_JPEG_QUALITY = 85


def label_colors(labels: NDArray[np.integer], truth: NDArray[np.integer] | None = None) -> NDArray[np.uint8]:
    """Color a label map, (H, W, 3) uint8 RGB; 0 becomes black.

    With a ground truth, segments have the colors of the regions they are matched to, largest overlaps first;
    other segments have colors that no region has.
    """
    colors = np.zeros((*labels.shape, 3), np.uint8)
    for value, place in _matched(labels, labels if truth is None else truth).items():
        colors[labels == value] = label_color(place + 1)
    return colors


def _matched(labels: NDArray[np.integer], truth: NDArray[np.integer]) -> dict[int, int]:
    """Return the place of the region that each label is matched to, beyond all regions for the others."""
    values, regions = np.unique(labels[labels > 0]), np.unique(truth[truth > 0])
    both = (labels > 0) & (truth > 0)
    rows = np.searchsorted(values, labels[both])
    columns = np.searchsorted(regions, truth[both])
    overlap = np.zeros((len(values), len(regions)), dtype=np.intp)
    np.add.at(overlap, (rows, columns), 1)
    number: dict[int, int] = {}
    while overlap.size and overlap.max() > 0:
        row, column = np.unravel_index(int(overlap.argmax()), overlap.shape)
        number[int(values[row])] = int(column)
        overlap[row], overlap[:, column] = 0, 0
    for place, value in enumerate(set(map(int, values)) - set(number)):
        number[value] = len(regions) + place
    return number


def depth_colors(depth_mm: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Color a depth image from near (yellow) to far (violet), (H, W, 3) uint8 RGB; black without depth."""
    known = depth_mm > 0
    if not known.any():
        return np.zeros((*depth_mm.shape, 3), np.uint8)
    near, far = np.percentile(depth_mm[known], (1, 99))
    return _mapped((far - depth_mm.astype(np.float32)) / max(far - near, 1.0), known, cv2.COLORMAP_VIRIDIS)


def error_colors(residual_m: NDArray[np.floating[Any]], most_m: float) -> NDArray[np.uint8]:
    """Color residuals as in the paper's figure 2, from blue at 0 to red at `most_m`; NaN becomes black."""
    return _mapped(np.nan_to_num(residual_m) / most_m, np.isfinite(residual_m), cv2.COLORMAP_JET)


def _mapped(share: NDArray[np.floating], known: NDArray[np.bool_], colormap: int) -> NDArray[np.uint8]:
    """Color shares from 0 to 1 by a map of OpenCV, RGB; unknown ones become black."""
    colors = cv2.applyColorMap((255 * np.clip(share, 0.0, 1.0)).astype(np.uint8), colormap)[:, :, ::-1].copy()
    colors[~known] = 0
    return np.asarray(colors, dtype=np.uint8)


def tile(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Scale an RGB image to a width; when reduced, pixels are averaged, so that thin borders remain."""
    height = round(image.shape[0] * width / image.shape[1])
    method = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), dtype=np.uint8)


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """Encode an RGB image as JPEG."""
    return bytes(cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def strip_png(tiles: Sequence[tuple[str, NDArray[np.uint8]]], width: int = 240) -> bytes:
    """Put RGB pictures of one shape side by side with captions, each `width` pixels wide, as PNG."""
    columns = []
    for caption, image in tiles:
        small = tile(image, width)
        head = np.full((22, width, 3), 255, np.uint8)
        cv2.putText(head, caption[:38], (3, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
        columns.append(np.vstack([head, small]))
        columns.append(np.full((columns[-1].shape[0], 4, 3), 255, np.uint8))
    return bytes(cv2.imencode(".png", np.hstack(columns[:-1])[:, :, ::-1])[1])
