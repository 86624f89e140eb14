"""Draw what settings do, on frames of the demo recording: the pictures of settings.md.

Needs what ``pip install '.[eval]'`` brings.

Usage: python docs/render_settings.py FOLDER [--only NAME]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg import RGBDFrame, SegmentationConfig, Segmenter, open_source, segment
from nurbseg.common.settings import setting_named, updated
from nurbseg.evaluation.report import pictures
from nurbseg.library.palette import label_colors
from nurbseg.segmentation.config import Level

_RECORDING = Path(__file__).resolve().parent.parent / "recordings" / "demo.mcap"
_TILE_PX = 280
#: What is drawn for a setting, surfaces or objects, and the values that it is given.
SERIES: dict[str, tuple[Level, Sequence[float | str]]] = {
    "ratio_max": ("surfaces", (0.5, 1.0, 1.3)),
    "metric": ("surfaces", ("nle", "mse", "vmxc")),
    "inverse_depth_noise": ("surfaces", (0.0005, 0.0022, 0.01)),
    "inverse_depth_gap": ("objects", (0.005, 0.025, 0.3)),
    "piece_pixels_min": ("surfaces", (10, 120, 4000)),
    "color_weight": ("surfaces", (0.0, 0.25, 3.0)),
    "log_odds_min": ("objects", (-5.0, 0.0, 8.0)),
}
#: In the second frame the cushion is larger than the carton, in the others it is smaller.
_MOMENTS = (0, 12, 24)

_Image = NDArray[np.uint8]


def draw_series(frames: Sequence[RGBDFrame], name: str) -> _Image:
    """Draw the first frame segmented with each value of a setting, objects in the same colors."""
    frame, (level, values) = frames[0], SERIES[name]
    tiles = []
    for value in values:
        config = updated(SegmentationConfig(), **{setting_named(SegmentationConfig, name)[0]: value})
        labels = segment(frame, config).labels(level)
        colors = pictures.label_colors(labels, frame.labels)
        tiles.append((f"--{name.replace('_', '-')} {value}", _over(frame, labels, colors)))
    return _strip(tiles)


def draw_level(frames: Sequence[RGBDFrame]) -> _Image:
    """Draw the first frame, its surfaces and its objects."""
    frame = frames[0]
    result = segment(frame)
    tiles = [("the color image", frame.color)]
    for level in ("surfaces", "objects"):
        labels = result.labels(level)
        colors = pictures.label_colors(labels, frame.labels)
        tiles.append((f"--level {level}", _over(frame, labels, colors)))
    return _strip(tiles)


def draw_temporal(frames: Sequence[RGBDFrame]) -> _Image:
    """Draw three moments without and with a live tree, each label in its own color."""
    palette = np.vstack([np.zeros((1, 3), dtype=np.uint8), label_colors()])
    rows = []
    for word, temporal in (("off", False), ("on", True)):
        segmenter, tiles = Segmenter(temporal=temporal), []
        for frame in frames[: _MOMENTS[-1] + 1]:
            labels = segmenter.process(frame).labels("objects")
            if frame.index in _MOMENTS:
                caption = f"--temporal {word}, frame {frame.index}"
                tiles.append((caption, _over(frame, labels, palette[labels])))
        rows.append(_strip(tiles))
    return np.vstack(rows)


def _over(frame: RGBDFrame, labels: NDArray[np.uint16], colors: _Image) -> _Image:
    """Return the colors of labels over the frame in gray, with white borders."""
    gray = cv2.cvtColor(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    image = cv2.addWeighted(colors, 0.65, gray, 0.35, 0.0)
    image[cv2.morphologyEx(labels, cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0] = 255
    return np.asarray(image, dtype=np.uint8)


def _strip(tiles: Sequence[tuple[str, _Image]]) -> _Image:
    png = np.frombuffer(pictures.strip_png(tiles, _TILE_PX), np.uint8)
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR)[:, :, ::-1], dtype=np.uint8)


DRAWN: dict[str, Callable[[Sequence[RGBDFrame]], _Image]] = {
    "level": draw_level,
    "temporal": draw_temporal,
    **{name: partial(draw_series, name=name) for name in SERIES},
}


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the pictures go; those that exist are replaced")
    parser.add_argument("--only", choices=DRAWN, help="draw the picture of this setting only")
    options = parser.parse_args()
    with open_source(_RECORDING) as source:
        frames = list(source)
    options.folder.mkdir(parents=True, exist_ok=True)
    for name in [options.only] if options.only else DRAWN:
        (options.folder / f"{name}.jpg").write_bytes(pictures.jpeg(DRAWN[name](frames)))


if __name__ == "__main__":
    main()
