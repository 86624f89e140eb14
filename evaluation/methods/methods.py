"""The methods to compare with, as functions ``method(cloud, rng) -> labels``, registered in `METHODS`."""

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.files import read_file
from nurbseg.common.limits import FRAME_BYTES_MAX
from nurbseg.common.settings import not_one_of
from nurbseg.drivers.datasets.images import decode
from nurbseg.evaluation.methods.flat import best_lambda
from nurbseg.evaluation.variants import FUNCTION_PREFIX, LABELS_PREFIX, TREE_METHODS, source_of
from nurbseg.segmentation.config import REFERENCE_PIXELS, SegmentationConfig
from nurbseg.segmentation.cut.features import features
from nurbseg.segmentation.points.registration import PointMap

Labels = NDArray[np.integer]

#: Number of segments of methods that need to know it.
CLUSTERS = 8
#: Takes a frame's points and its only source of random numbers; returns labels (H, W). The label 0 and pixels
#: without a point do not count.
LabelMethod = Callable[[PointMap, np.random.Generator], Labels]

#: Minimum region size of the graph-based methods, pixels of a 640x480 image.
_SMALLEST_PX = 750


def dmzc12(cloud: PointMap, rng: np.random.Generator, config: SegmentationConfig | None = None) -> Labels:
    """Flat spectral clustering with the lambda of best unsupervised quality; see `best_lambda`."""
    seed = int(rng.integers(2**31))
    return best_lambda(cloud, config or SegmentationConfig(), clusters=CLUSTERS, seed=seed)[1]


def _filled_depth(cloud: PointMap) -> NDArray[np.float32]:
    """Fill holes with the depth of the nearest pixel, meters."""
    depth_m = np.where(cloud.valid, cloud.points_m[:, :, 2], 0.0).astype(np.float32)
    missing = (~cloud.valid).astype(np.uint8)
    if missing.all():
        return depth_m
    _, nearest = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[cloud.valid]] = depth_m[cloud.valid]
    return np.asarray(by_label[nearest], dtype=np.float32)


def fh04_color(cloud: PointMap, rng: np.random.Generator) -> Labels:
    """Graph-based segmentation of the color image [1]_, by scikit-image.

    Scale 1000, sigma 0.8 and a minimum size of 750 pixels at 640x480, proportional at other sizes.

    References
    ----------
    .. [1] P. Felzenszwalb, D. Huttenlocher, "Efficient graph-based image segmentation", IJCV 59(2), 2004.
    """
    return _felzenszwalb(cloud.color)


def fh04_color_depth(cloud: PointMap, rng: np.random.Generator) -> Labels:
    """Graph-based segmentation of color and depth, by scikit-image.

    Depth, with holes filled from the nearest pixel, is a fourth channel with the weight of the other three.
    """
    depth_m = _filled_depth(cloud)
    low, high = np.percentile(depth_m, (1, 99))
    depth = 3.0 * np.clip((depth_m - low) / max(high - low, 1e-9), 0.0, 1.0).astype(np.float64)
    return _felzenszwalb(np.dstack([cloud.color / 255.0, depth]))


def _felzenszwalb(image: NDArray[Any]) -> Labels:
    from skimage.segmentation import felzenszwalb

    smallest = max(1, round(_SMALLEST_PX * image.shape[0] * image.shape[1] / REFERENCE_PIXELS))
    with warnings.catch_warnings():
        # It warns about four channels although the channel axis is given.
        warnings.filterwarnings("ignore", "Got image with third dimension", RuntimeWarning)
        found = felzenszwalb(image, scale=1000, sigma=0.8, min_size=smallest, channel_axis=2)
    return np.asarray(found) + 1


def slic_ncut(cloud: PointMap, rng: np.random.Generator) -> Labels:
    """Superpixels (SLIC) joined by recursive normalized cuts of their color graph, by scikit-image."""
    from skimage import graph
    from skimage.segmentation import slic

    superpixels = slic(cloud.color, n_segments=400, compactness=30, start_label=1)
    adjacency = graph.rag_mean_color(cloud.color, superpixels, mode="similarity")
    return np.asarray(graph.cut_normalized(superpixels, adjacency, rng=rng)) + 1


def kmeans(cloud: PointMap, rng: np.random.Generator, *, clusters: int) -> Labels:
    """k-means of the 6-D vectors of color and position (eq. 3), by scikit-learn."""
    from sklearn.cluster import MiniBatchKMeans

    vectors = features(cloud, SegmentationConfig())
    labels = np.zeros(cloud.valid.shape, np.int32)
    if len(vectors) < clusters:
        labels[cloud.valid] = 1
        return labels
    model = MiniBatchKMeans(
        n_clusters=clusters, n_init=3, batch_size=4096, random_state=int(rng.integers(2**31))
    )
    labels[cloud.valid] = model.fit_predict(vectors) + 1
    return labels


#: All methods by name, except the tree methods, which share work between settings.
METHODS: Mapping[str, LabelMethod] = {
    "dmzc12": dmzc12,
    "fh04": fh04_color,
    "fh04-depth": fh04_color_depth,
    "slic-ncut": slic_ncut,
    "kmeans": partial(kmeans, clusters=CLUSTERS),
}


def check_method(name: str) -> None:
    """Check that a method exists and can run here.

    Raises ValueError if there is no such method or folder of label images.
    """
    if name.startswith(LABELS_PREFIX):
        folder = Path(name.removeprefix(LABELS_PREFIX))
        if not folder.is_dir():
            raise ValueError(f"--labels {folder}: no such folder")
    elif name.startswith(FUNCTION_PREFIX):
        method_from(name.removeprefix(FUNCTION_PREFIX))
    elif name not in METHODS and name not in TREE_METHODS:
        raise ValueError(f"methods: {not_one_of((*TREE_METHODS, *METHODS), name)}")


def method_from(name: str) -> LabelMethod:
    """Return a function of another module, ``module:function``, whose labels are checked.

    Raises ValueError if there is none.
    """
    module, _, function = name.partition(":")
    source_of(module)
    found = getattr(import_module(module), function, None)
    if not callable(found):
        raise ValueError(f"--method-from {name}: expected MODULE:FUNCTION, and {module} has no such function")

    def checked(cloud: PointMap, rng: np.random.Generator) -> Labels:
        labels = np.asarray(found(cloud, rng))
        if labels.shape != cloud.valid.shape or labels.dtype.kind not in "ui":
            expected = f"labels {cloud.valid.shape} of whole numbers"
            raise ValueError(f"{name}: expected {expected}, got {labels.shape} {labels.dtype}")
        return labels

    return checked


def labels_on_disk(folder: Path, frame_name: str, index: int, shape: tuple[int, ...]) -> Labels:
    """Read another program's labels of a frame, whose depth image has this shape, (H, W).

    ``NAME_labels.png``, ``NAME_label.png``, ``NAME.png``, ``NNNNNN_labels.png`` and ``NNNNNN.png`` (the
    frame's number) are tried in this order. Raises ValueError if none exists, or it is damaged, of another
    shape or not of whole numbers.
    """
    names = [f"{index:06d}_labels.png", f"{index:06d}.png"]
    if frame_name:
        names = [f"{frame_name}_labels.png", f"{frame_name}_label.png", f"{frame_name}.png", *names]
    for name in names:
        path = folder / name
        if path.exists():
            content = read_file(path, FRAME_BYTES_MAX, what="label image")
            image = decode(content, cv2.IMREAD_UNCHANGED, f"{path}")
            if image.shape != shape or image.dtype.kind not in "ui":
                found = f"{image.shape} {image.dtype}"
                raise ValueError(f"{path}: expected labels {shape} of whole numbers, got {found}")
            return np.asarray(image, dtype=np.int64)
    raise ValueError(f"{folder}: no labels of frame {frame_name or index}; expected {names[0]}")
