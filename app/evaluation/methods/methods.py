"""The methods to compare with, as functions ``method(cloud, rng) -> labels``, registered in `METHODS`."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.evaluation.methods import pcl, rivals
from nurbseg.app.evaluation.methods.flat import best_lambda
from nurbseg.app.evaluation.variants import LABELS_PREFIX, TREE_METHODS
from nurbseg.drivers.datasets.images import decode
from nurbseg.drivers.files import read_file
from nurbseg.drivers.limits import FRAME_BYTES_MAX
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap

#: Number of segments of methods that need to know it.
CLUSTERS = 8


#: Takes a frame's points and its only source of random numbers; returns labels (H, W). The label 0 and pixels
#: without a point do not count.
LabelMethod = Callable[[PointMap, np.random.Generator], NDArray[np.integer]]


def dmzc12(
    cloud: PointMap, rng: np.random.Generator, config: SegmentationConfig | None = None
) -> NDArray[np.integer]:
    """Flat spectral clustering with the lambda of best unsupervised quality; see `best_lambda`."""
    seed = int(rng.integers(2**31))
    return best_lambda(cloud, config or SegmentationConfig(), clusters=CLUSTERS, seed=seed)[1]


#: All methods by name, except the tree methods, which share work between settings.
METHODS: Mapping[str, LabelMethod] = {
    "dmzc12": dmzc12,
    "fh04": rivals.fh04_color,
    "fh04-depth": rivals.fh04_color_depth,
    "slic-ncut": rivals.slic_ncut,
    "kmeans": partial(rivals.kmeans, clusters=CLUSTERS),
    "lccp": pcl.lccp,
    "pcl-organized": pcl.organized,
}


def check_method(name: str) -> None:
    """Check that a method exists and can run here.

    Raises ValueError if there is no such method or folder of label images, and BackendMissingError if a
    program it needs is not installed.
    """
    if name.startswith(LABELS_PREFIX):
        folder = Path(name.removeprefix(LABELS_PREFIX))
        if not folder.is_dir():
            raise ValueError(f"--labels {folder}: no such folder")
    elif name not in METHODS and name not in TREE_METHODS:
        known = ", ".join((*TREE_METHODS, *METHODS))
        raise ValueError(f"methods: expected some of {known}, got {name!r}")
    elif name in ("lccp", "pcl-organized"):
        pcl.program()


def labels_on_disk(folder: Path, frame_name: str, index: int) -> NDArray[np.integer]:
    """Read another program's labels of a frame, (H, W).

    ``NAME_labels.png``, ``NAME_label.png``, ``NAME.png``, ``NNNNNN_labels.png`` and ``NNNNNN.png`` (the
    frame's number) are tried in this order. Raises ValueError if none exists, or it is damaged or
    has several channels.
    """
    names = [f"{index:06d}_labels.png", f"{index:06d}.png"]
    if frame_name:
        names = [f"{frame_name}_labels.png", f"{frame_name}_label.png", f"{frame_name}.png", *names]
    for name in names:
        path = folder / name
        if path.exists():
            content = read_file(path, FRAME_BYTES_MAX, what="label image")
            image = decode(content, cv2.IMREAD_UNCHANGED, f"{path}")
            if image.ndim != 2 or image.dtype.kind not in "ui":
                raise ValueError(f"{path}: expected a label image of one channel of whole numbers")
            return np.asarray(image, dtype=np.int64)
    raise ValueError(f"{folder}: no labels of frame {frame_name or index}; expected {names[0]}")
