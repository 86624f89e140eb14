"""How well surfaces agree with the faces of objects: on the rendered scene and on annotated frames.

Examples
--------
The rendered scene alone, then frames whose faces tests/faces holds, as in docs/accuracy.md::

    python benchmarks/faces.py
    python benchmarks/faces.py FOLDER FOLDER --intrinsics 525,525,319.5,239.5
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from ablation import Frames, registered
from labelled import frames_of, frames_parser
from numpy.typing import NDArray
from rendered import SyntheticOptions, SyntheticSource

from nurbseg.common.frame import RGBDFrame
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import register

ANNOTATED = Path(__file__).parent.parent / "tests" / "faces"
#: Two frames of each scene, half a period apart.
RENDERED = tuple(f"labels=surfaces&seed={seed}&frames=2&fps=0.5" for seed in range(1, 5))
#: A face is found by a surface with this intersection over union, an F measure of .75.
_FOUND = 0.6


def rendered_frames() -> Frames:
    """Render frames whose labels are faces."""
    frames: list[RGBDFrame] = []
    for scene in RENDERED:
        with SyntheticSource(SyntheticOptions.from_text(scene)) as source:
            frames += source
    return registered(frames)


def annotated(frames: list[RGBDFrame], faces: Path) -> Frames:
    """Return the frames of which a folder holds the faces, as NAME.png."""
    found = []
    for frame in frames:
        if (faces / f"{frame.name}.png").exists():
            truth = cv2.imread(str(faces / f"{frame.name}.png"), cv2.IMREAD_UNCHANGED)
            found.append((register(frame), np.asarray(truth, dtype=np.uint16)))
    return found


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
    parser = frames_parser(__doc__, "folders of pairs or recordings with annotated frames", "*")
    parser.add_argument("--faces", type=Path, default=ANNOTATED, help="label images of faces (%(default)s)")
    given = parser.parse_args()
    real = [each for path in given.frames for each in annotated(frames_of(path, given), given.faces)]
    if given.frames and not real:
        print(f"{given.faces}: has no faces of these frames", file=sys.stderr)
        return 2
    print("| frames | GTRC | VoI | under | over | obj | found | surfaces a face |")
    print("|---" * 8 + "|")
    for name, frames in (("rendered", rendered_frames()), ("annotated", real)):
        seeds = [replace(SegmentationConfig(), seed=seed) for seed in range(given.seeds)]
        if frames:
            means = np.mean([measured(frames, config) for config in seeds], axis=(0, 1))
            cells = [f"{len(frames)} {name}", *(f"{mean:.3f}" for mean in means)]
            print("| " + " | ".join(cells) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
