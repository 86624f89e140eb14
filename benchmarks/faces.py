"""How well surfaces agree with the faces of objects: on the rendered scene and on annotated frames.

Examples
--------
The rendered scene alone, then frames whose faces tests/faces holds, as in docs/accuracy.md::

    python benchmarks/faces.py
    python benchmarks/faces.py FOLDER FOLDER --intrinsics 525,525,319.5,239.5
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, register
from nurbseg.segmentation.scoring.scores import Contingency

ANNOTATED = Path(__file__).parent.parent / "tests" / "faces"
#: Two frames of each scene, half a period apart.
RENDERED = tuple(f"synthetic:?labels=surfaces&seed={seed}&frames=2&fps=0.5" for seed in range(1, 5))
#: A face is found by a surface with this intersection over union, an F measure of .75.
_FOUND = 0.6

Frames = list[tuple[PointMap, NDArray[np.uint16]]]


def rendered_frames() -> Frames:
    """Render frames whose labels are faces."""
    frames = []
    for uri in RENDERED:
        with open_source(uri) as source:
            frames += [(register(frame), frame.labels) for frame in source if frame.labels is not None]
    return frames


def annotated_frames(path: str, options: SourceOptions, faces: Path) -> Frames:
    """Read the frames of a recording of which a folder holds the faces, as NAME.png."""
    frames = []
    with open_source(path, options) as source:
        for frame in source:
            if (faces / f"{frame.name}.png").exists():
                truth = cv2.imread(str(faces / f"{frame.name}.png"), cv2.IMREAD_UNCHANGED)
                frames.append((register(frame), np.asarray(truth, dtype=np.uint16)))
    return frames


def measured(frames: Frames, config: SegmentationConfig) -> NDArray[np.float64]:
    """Score the surfaces of every frame: (frames, 7), in the order of the table."""
    rows = []
    for cloud, truth in frames:
        table = Contingency.between(segment(cloud, config).labels("surfaces"), truth)
        surfaces, faces = table.pixels.shape
        rows.append(
            [
                table.region_covering(),
                table.variation_of_information(),
                table.under_segmentation_bits(),
                table.over_segmentation_bits(),
                table.object_iou(),
                table.found_regions(_FOUND) / faces,
                surfaces / faces,
            ]
        )
    return np.array(rows)


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", nargs="*", help="folders of pairs or recordings with annotated frames")
    parser.add_argument("--intrinsics", help="fx,fy,cx,cy in pixels, for folders without calibration")
    parser.add_argument("--faces", type=Path, default=ANNOTATED, help="label images of faces (%(default)s)")
    parser.add_argument("--seeds", type=int, default=5, help="seeds of the segmentation (%(default)s)")
    given = parser.parse_args()
    options = SourceOptions()
    if given.intrinsics:
        fx, fy, cx, cy = (float(each) for each in given.intrinsics.split(","))
        options = SourceOptions(intrinsics=(fx, fy, cx, cy))
    try:
        annotated = [each for path in given.frames for each in annotated_frames(path, options, given.faces)]
    except DriverError as err:
        print(err, file=sys.stderr)
        return 2
    if given.frames and not annotated:
        print(f"{given.faces}: has no faces of these frames", file=sys.stderr)
        return 2
    print("| frames | GTRC | VoI | under | over | obj | found | surfaces a face |")
    print("|---" * 8 + "|")
    for name, frames in (("rendered", rendered_frames()), ("annotated", annotated)):
        seeds = [replace(SegmentationConfig(), seed=seed) for seed in range(given.seeds)]
        if frames:
            means = np.mean([measured(frames, config) for config in seeds], axis=(0, 1))
            cells = [f"{len(frames)} {name}", *(f"{mean:.3f}" for mean in means)]
            print("| " + " | ".join(cells) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
