"""Boxes of objects against those of the rendered scene, of which they are known: place, size and turn.

Boxes, the book and the cushion are not round: their turn is known. Of each kind, and of all of these: median
and 95 % of the errors of center (mm), size (largest side, %) and turn (degrees), and how often each
coordinate, side and turn is off by no more than the standard deviation stated of it (2 in 3 is right).

Examples
--------
::

    python benchmarks/boxes.py --seeds 0,1,2 --frames 60
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from typing import NamedTuple

import numpy as np
from rendered import SyntheticOptions, SyntheticSource

from nurbseg import MeasuredObject, Segmenter

#: Objects whose footprint is not round.
NOT_ROUND = ("carton", "packet", "book", "cushion")
#: Least overlap (intersection over union) of an object with the true one, and its least size, pixels.
OVERLAP_MIN, PIXELS_MIN = 0.5, 200


class Errors(NamedTuple):
    """Errors of one box, and which of them the stated deviations hold."""

    center_mm: float
    size_percent: float
    turn_degrees: float
    center_held: float
    size_held: float
    turn_held: float


def main() -> None:
    """Print a table for frames alone and one for frames that continue each other."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="0,1,2", help="of the scenes (0,1,2)")
    parser.add_argument("--frames", type=int, default=60, help="of each scene (60)")
    arguments = parser.parse_args()
    for temporal in (False, True):
        found: dict[str, list[Errors]] = defaultdict(list)
        for seed in map(int, arguments.seeds.split(",")):
            for name, errors in boxes(seed, arguments.frames, temporal=temporal):
                found[name].append(errors)
        found["not round"] = [each for name in NOT_ROUND for each in found[name]]
        print("frames that continue each other" if temporal else "frames alone, every sixth")
        print("| | boxes | center mm | 95 % | size % | 95 % | turn deg | 95 % | held |")
        for name, rows in found.items():
            values = np.array(rows)
            middle, most = np.median(values, axis=0), np.percentile(values, 95, axis=0)
            errors = " | ".join(f"{middle[n]:.1f} | {most[n]:.1f}" for n in range(3))
            held = " ".join(f"{share:.2f}" for share in values[:, 3:].mean(axis=0))
            print(f"| {name} | {len(rows)} | {errors} | {held} |")


def boxes(seed: int, frames: int, *, temporal: bool) -> list[tuple[str, Errors]]:
    """Return the errors of the boxes of a scene, with the names of the objects."""
    found = []
    segmenter = Segmenter(temporal=temporal)
    with SyntheticSource(SyntheticOptions(seed=seed, frames=frames)) as source:
        for frame in source:
            if not temporal and frame.index % 6:
                continue
            result = segmenter.process(frame)
            measured = {each.label: each for each in result.objects}
            image = result.labels("objects")
            world_from_camera, poses = source.poses(frame.index)
            for label, name in source.label_names.items():
                true = frame.labels == label
                if name in ("table", "wall") or np.count_nonzero(true) < PIXELS_MIN:
                    continue
                labels, counts = np.unique(image[true & (image > 0)], return_counts=True)
                if not labels.size:
                    continue
                best = int(labels[counts.argmax()])
                if counts.max() < OVERLAP_MIN * np.count_nonzero(true | (image == best)):
                    continue
                corners = source.corners_m(label)
                camera_from_object = np.linalg.inv(world_from_camera) @ poses[label]
                found.append((name, errors_of(measured[best], corners, camera_from_object)))
    return found


def errors_of(each: MeasuredObject, corners_m: np.ndarray, camera_from_object: np.ndarray) -> Errors:
    """Compare a box with the one around the corners of an object in its own frame."""
    turn = camera_from_object[:3, :3]
    middle = turn @ (corners_m.max(axis=0) + corners_m.min(axis=0)) / 2 + camera_from_object[:3, 3]
    sides = np.ptp(corners_m, axis=0)
    first = each.box.axes[0] @ turn
    angle = np.degrees(np.arctan2(first[1], first[0]))
    quarters = round(angle / 90)
    size = each.box.size_m[[1, 0, 2]] if quarters % 2 else each.box.size_m
    off_m = each.box.axes @ (each.box.center_m - middle)
    off_turn = abs(angle - 90 * quarters)
    return Errors(
        1e3 * float(np.linalg.norm(off_m)),
        100 * float(np.abs(size / sides - 1).max()),
        off_turn,
        float(np.mean(np.abs(off_m) <= each.sigma.center_m)),
        float(np.mean(np.abs(size - sides) <= each.sigma.size_m)),
        float(np.radians(off_turn) <= each.sigma.yaw_rad),
    )


if __name__ == "__main__":
    main()
