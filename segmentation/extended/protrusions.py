"""Things in front of a large surface that are too small to raise its error: each becomes a surface."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Intp, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.folding import UNFINISHED
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.memory import LeafMemory
from nurbseg.segmentation.extended.parts import chain_components, nodes_of
from nurbseg.segmentation.labels.regions import connected_components
from nurbseg.segmentation.points.grid import union
from nurbseg.segmentation.segments import Node, leaves_below
from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Side of the square that a protrusion has room for, pixels of a 640-wide image: strips at borders have none.
_SIDE_PX = 8.0
#: Share of a leaf that protrudes, at most: where it is more, the surface is what is wrong.
_SHARE_MOST = 0.5


def split_off_protrusions(
    root: Node,
    features: GridFeatures,
    config: SegmentationConfig,
    is_asked: Callable[[Node, int], bool] = lambda leaf, far: True,
) -> None:
    """Split off connected points that are in front of the surface of their leaf by more than noise.

    Noise is that of the setting or, where it is larger, the root mean square of the surface's residuals.

    The ratio (eq. 5) compares means over a segment. A thing that is a small share of a large surface hardly
    changes them, however far it protrudes; here each point counts by itself. A protrusion is connected, has
    at least T_p points, and holds a square of 8 pixels. It and what remains of the leaf are fitted anew.

    Parameters
    ----------
    root : Node
        Of a tree that has grown, which is changed. One that a limit stopped is left as it is. A leaf with
        protrusions gets two parts: what remains, and the protrusion, or a node without a surface that
        chains several.
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        The limit `protrusion_min`, the noise and T_p.
    is_asked : callable
        Whether a leaf is looked at, given it and how many of its grid pixels are far from its surface: in a
        tree that is continued only where these have become more. Called for each leaf that has a surface.
    """
    leaves = leaves_below(root)
    if any(leaf.stop in UNFINISHED for leaf in leaves):
        return
    labels = _in_front_of_surfaces(leaves, features, config, is_asked)
    found = connected_components(labels, features.adjacency, features.grid_pixels_min(config))
    marked = np.flatnonzero(labels > 0)
    numbers = found.numbers.reshape(-1)[marked]
    side = max(1, round(_SIDE_PX * features.grid.unit_px / features.grid.step))
    square = np.ones((side, side), dtype=np.uint8)
    protrusions: dict[int, list[NDArray[np.intp]]] = {}
    for number in range(1, found.labels_of.size):
        grid_pixels = marked[numbers == number]
        mask = features.grid.window_mask(grid_pixels)[1].astype(np.uint8)
        if cv2.erode(mask, square, borderType=cv2.BORDER_CONSTANT, borderValue=0).any():
            protrusions.setdefault(int(found.labels_of[number]), []).append(grid_pixels)
    for label, pieces in protrusions.items():
        _split_off(leaves[label - 1], pieces, features, config)


def _in_front_of_surfaces(
    leaves: list[Node],
    features: GridFeatures,
    config: SegmentationConfig,
    is_asked: Callable[[Node, int], bool],
) -> NDArray[np.int32]:
    """Mark grid pixels that are nearer than their leaf's surface by more than the limit, by label.

    Leaves in which fewer than T_p are have none marked.
    """
    extended = config.extended
    limits_per_m = extended.protrusion_min * np.maximum(
        extended.inverse_depth_noise, [0.0, *(leaf.fit.rms_per_m for leaf in leaves)]
    )
    grid, least = features.grid, features.grid_pixels_min(config)
    labels = np.zeros(grid.valid.shape, dtype=np.int32)
    flat, inverse_depth = labels.reshape(-1), grid.inverse_depth.ravel()
    distances_m = grid.distances_m.ravel()
    surfaces: list[NurbsSurface | None] = [None] * len(leaves)
    for label, leaf in enumerate(leaves, start=1):
        if leaf.fit.surface is not None:
            far = _far_from_surface(
                leaf.grid_pixels, leaf.fit.residuals_m, inverse_depth, distances_m, limits_per_m[label]
            )
            if is_asked(leaf, far.size) and far.size >= least:
                flat[far], surfaces[label - 1] = label, leaf.fit.surface
    marked = np.flatnonzero(flat > 0)
    rows, columns = np.divmod(marked.astype(np.int32), np.int32(grid.shape[1]))
    step = np.int32(grid.step)
    explained = SurfaceTable(surfaces).inverse_depths(flat[marked], rows * step, columns * step)
    flat[marked[inverse_depth[marked] - explained <= limits_per_m[flat[marked]]]] = 0
    return labels


@compiled
def _far_from_surface(
    grid_pixels: Intp, residuals_m: F64, inverse_depth: F32, distances_m: F32, limit_per_m: float
) -> Intp:
    """Return the grid pixels that are farther from a surface than those nearer by the limit can be.

    A point at distance p, nearer than the surface by r 1/m, is more than r p / d away from it.
    """
    far, count = np.empty_like(grid_pixels), 0
    for n in range(grid_pixels.size):
        pixel = grid_pixels[n]
        far[count] = pixel
        count += residuals_m[n] * inverse_depth[pixel] > limit_per_m * distances_m[pixel]
    return far[:count].copy()


def _split_off(
    leaf: Node, pieces: list[NDArray[np.intp]], features: GridFeatures, config: SegmentationConfig
) -> None:
    """Divide a leaf into what remains and its protrusions, unless these are most of it."""
    protruding = union(pieces)
    if protruding.size > _SHARE_MOST * leaf.grid_pixels.size:
        return
    remaining = np.delete(leaf.grid_pixels, np.searchsorted(leaf.grid_pixels, protruding))
    rest, *parts = nodes_of(features.fitter.of_pixels([remaining, *pieces]), config)
    for part in (rest, *parts):
        part.stop = part.stop or StopReason.UNTRIED
    rest.memory, leaf.memory = leaf.memory, None
    if isinstance(rest.memory, LeafMemory):
        # It has fewer points far from its surface now, and what was tried of it was tried with all.
        rest.memory.far = rest.memory.attempt = None
    name, depth = leaf.name, leaf.cuts_above
    leaf.children = chain_components(f"{name}0", [rest], depth), chain_components(f"{name}1", parts, depth)
    leaf.division, leaf.stop, leaf.trial = Division.PROTRUSION, None, None
