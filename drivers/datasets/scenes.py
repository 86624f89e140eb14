"""Data sets with a folder for each scene, as that of the paper (LTTM): images, calibration and labels.

The folder holds ``scene1``, ``scene2``, ... (or ``scene_1``, ...); each of them a color image, a depth
image, the ground truth (``color.png``, ``depth.png``, ``labels.png``, or any names that `find_pairs`
knows) and the calibration of both cameras in OpenCV's form (``calibration.xml`` or ``.yml``).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.drivers.datasets.folders import PairSource, Shot, folder_camera
from nurbseg.drivers.datasets.pairs import NAMES_EXPECTED, find_pairs
from nurbseg.drivers.datasets.sequence import FRAME_INTERVAL_NS, natural_key
from nurbseg.drivers.errors import RecordingFormatError

if TYPE_CHECKING:
    from nurbseg.drivers.options import SourceOptions

_SCENE = re.compile(r"scene[ _-]?\d+", re.IGNORECASE)


def scene_folders(folder: Path) -> list[Path]:
    """Return the scenes of a data set in natural order; none where the folder is something else."""
    found = [path for path in folder.iterdir() if path.is_dir() and _SCENE.fullmatch(path.name)]
    return sorted(found, key=lambda path: natural_key(path.name))


def open_scenes(folder: Path, options: SourceOptions) -> PairSource:
    """Open a data set of scenes, one after the other; each scene brings its own calibration.

    Raises RecordingFormatError if there is no scene, or one without a pair of images; CalibrationError if a
    scene has no calibration, or an unusable one.
    """
    shots: list[Shot] = []
    for scene in scene_folders(folder):
        pairs, _ = find_pairs(scene)
        if not pairs:
            raise RecordingFormatError(f"{scene}: no image pairs; expected {NAMES_EXPECTED}")
        camera = folder_camera(scene, options)
        for pair in pairs:
            name = f"{scene.name}_{pair.name}" if pair.name else scene.name
            shots.append(Shot(replace(pair, name=name), camera, len(shots) * FRAME_INTERVAL_NS))
    if not shots:
        raise RecordingFormatError(f"{folder}: no scenes; expected the folders scene1, scene2, ...")
    return PairSource(folder, shots, "folder of scenes")
