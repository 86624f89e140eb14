"""Simulated frames with exact labels: tabletops and rooms, to train merging and to test it.

Writes NAME_color.png, NAME_depth.png (millimeters, as a Kinect would measure it) and NAME_label.png: 1 to 9
are parts of table, floor and walls, 10 k + i is part i of object k. Intrinsics are 525,525,319.5,239.5. What
is written for a seed is always the same.

Examples
--------
Needs pybullet and embreex::

    python benchmarks/scenes/make.py tabletops FOLDER --frames 150 --seed 21
    python benchmarks/scenes/make.py rooms FOLDER --frames 150 --seed 22
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rooms import room
from sensor import photographed
from tabletops import SUPPORT, tabletop

_FAMILIES = {"tabletops": tabletop, "rooms": room}
#: Numbers from this on are objects. Of both, pieces that have as few pixels have no label.
_OBJECTS, _PIECE_MIN = 10, 40
#: Pixels of the width over which a part of table, floor or wall is one with another.
_BRIDGE = 7
#: Objects of this many pixels that a frame has at least, and its share of pixels with depth.
_OBJECTS_MIN, _PIXELS_MIN, _DEPTH_MIN = {"tabletops": 3, "rooms": 6}, 300, 0.4


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("family", choices=tuple(_FAMILIES))
    parser.add_argument("out", type=Path, help="folder for the images")
    parser.add_argument("--frames", type=int, default=60, help="number of frames (%(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first frame (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the scenes (%(default)s)")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    for index in range(given.first, given.first + given.frames):
        images = frame(given.family, given.seed, index)
        for kind, image in images.items():
            cv2.imwrite(str(given.out / f"{given.family}{index:03d}_{kind}.png"), image)
    return 0


def frame(family: str, seed: int, index: int) -> dict[str, NDArray[np.generic]]:
    """Make a frame: color, depth and label; it is the same whatever the others are."""
    for attempt in range(100):
        rng = np.random.default_rng([seed, index, attempt])
        solids, camera, cut = _FAMILIES[family](rng)
        picture = photographed([solid for _, solid in solids], camera, rng.uniform(0.6, 1.5), rng)
        number = np.array([0, *(number for number, _ in solids)])[picture.solid]
        if cut:
            number[(number > SUPPORT) & (number < _OBJECTS)] = 0
        depth_mm = np.where(number > 0, picture.depth_mm, 0).astype(np.uint16)
        _, pixels = np.unique(number[number >= _OBJECTS], return_counts=True)
        # Frames of a table that is cut out have little depth.
        deep = (depth_mm > 0).mean() > _DEPTH_MIN * (0.5 if cut else 1.0)
        if deep and (pixels >= _PIXELS_MIN).sum() >= _OBJECTS_MIN[family]:
            return {"color": picture.color, "depth": depth_mm, "label": _labels(number)}
    raise RuntimeError(f"no scene for {family} {seed} {index}")


def _labels(number: NDArray[np.intp]) -> NDArray[np.uint16]:
    """Return a label for each part of table, floor and walls, and for each of objects."""
    labels = np.zeros(number.shape, dtype=np.uint16)
    ground = [piece for n in range(1, _OBJECTS) for piece in _pieces(number == n, _BRIDGE)]
    for label, piece in enumerate(sorted(ground, key=np.count_nonzero, reverse=True)[:9], start=1):
        labels[piece] = label
    for n in np.unique(number[number >= _OBJECTS]):
        own = sorted(_pieces(number == n, 1), key=np.count_nonzero, reverse=True)
        for part, piece in enumerate(own[:10]):
            labels[piece] = 10 * (n - _OBJECTS + 1) + part
    return labels


def _pieces(mask: NDArray[np.bool_], bridge: int) -> list[NDArray[np.bool_]]:
    """Return connected parts of a region; what joins them has to have a width."""
    square = np.ones((bridge, bridge), np.uint8)
    core = cv2.erode(mask.astype(np.uint8), square, borderValue=1)
    _, numbers, counted, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    large = np.flatnonzero(counted[1:, cv2.CC_STAT_AREA] >= _PIECE_MIN) + 1
    if large.size == 0:
        return []
    far = (~np.isin(numbers, large)).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(far, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of = np.zeros(int(nearest.max()) + 1, dtype=numbers.dtype)
    of[nearest[far == 0]] = numbers[far == 0]
    return [mask & (of[nearest] == each) for each in large]


if __name__ == "__main__":
    raise SystemExit(main())
