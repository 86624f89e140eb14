"""What views are given of a frame: images, points, a mesh and words, ready to be shown, and no more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.frame import Calibration
from nurbseg.segmentation.config import Metric
from nurbseg.segmentation.vocabulary import Division, StopReason


@dataclass(frozen=True, slots=True)
class Moment:
    """When something was: the frame's number, and the device's clock.

    Parameters
    ----------
    frame : int
        Number of the frame.
    device_ns : int or None
        Nanoseconds; None before the first frame.
    since_epoch : bool
        Whether the device's clock is a date; otherwise it counts from some start.
    """

    frame: int
    device_ns: int | None
    since_epoch: bool


@dataclass(frozen=True, slots=True)
class TreeNode:
    """One segment of the tree, as it is drawn and listed."""

    name: str
    children: tuple[str, ...]
    #: Label of a leaf; None where it was split.
    label: int | None
    #: Label of the object that a leaf belongs to; None where surfaces are not merged into objects.
    thing: int | None
    pixels: int
    #: The deciding metric; None where it was not measured.
    value: float | None
    ratio: float | None
    stop: StopReason | None
    division: Division | None
    has_surface: bool
    #: Frames in which the value, and the ratio or the reason, were found; None for the frame itself.
    measured: int | None
    judged: int | None


@dataclass(frozen=True, slots=True, eq=False)
class ViewFrame:
    """One frame as it is shown.

    Parameters
    ----------
    moment : Moment
        When it was.
    name : str
        What the source calls it; may be empty.
    metric : str
        Which of the metrics is shown.
    calibration : Calibration or None
        Of its cameras; None where it is that of the frame before.
    color : (H, W, 3) uint8
        RGB on the depth camera's grid.
    unregistered_color : (h, w, 3) uint8 or None
        RGB as it was captured, where that is another image.
    depth_mm : (H, W) uint16
        Millimetres; 0 for no depth.
    surfaces : (H, W) uint16
        Surface of each pixel; 0 for none.
    objects : (H, W) uint16 or None
        Object of each pixel, where surfaces were merged into objects.
    truth : (H, W) uint16 or None
        Ground truth.
    truth_match : (R, 2) uint16 or None
        Regions of the ground truth, and the object or segment that overlaps each most; 0 for none.
    points_m : (N, 3) float32
        Some of the points, metres.
    point_labels : (N,) uint16
        Object of each, or surface where there are no objects.
    vertices_m, normals : (V, 3) float32
        Mesh of the surfaces, metres and unit vectors.
    triangles : (T, 3) uint32
        Rows of the vertices.
    residuals_m : (V,) float32
        Mean distance of the data around each vertex to the surface, metres.
    vertex_surfaces : (V,) uint16
        Surface of each vertex.
    isolines : (N,) uint32
        Rows of the vertices on lines of constant parameter, line after line.
    isoline_sizes : (L,) intp
        Vertices of each line.
    tree : tuple of TreeNode
        Depth first, the root first.
    merges : tuple of str
        Of each object that several surfaces were merged into, which and by what evidence.
    elapsed_ms : mapping of str to float
        Time that each stage took until now, milliseconds.
    rate_hz : float
        Frames shown in a second; 0 where it is not known yet.
    events : tuple of str
        What happened to segments since the frame before.
    grid_step : int or None
        Step of the live tree's grid, pixels.
    reset_reason : str
        Why the live tree was reset; empty where it went on.
    """

    moment: Moment
    name: str
    metric: Metric
    calibration: Calibration | None
    color: NDArray[np.uint8]
    unregistered_color: NDArray[np.uint8] | None
    depth_mm: NDArray[np.uint16]
    surfaces: NDArray[np.uint16]
    objects: NDArray[np.uint16] | None
    truth: NDArray[np.uint16] | None
    truth_match: NDArray[np.uint16] | None
    points_m: NDArray[np.float32]
    point_labels: NDArray[np.uint16]
    vertices_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    residuals_m: NDArray[np.float32]
    vertex_surfaces: NDArray[np.uint16]
    isolines: NDArray[np.uint32]
    isoline_sizes: NDArray[np.intp]
    tree: tuple[TreeNode, ...]
    merges: tuple[str, ...]
    elapsed_ms: Mapping[str, float]
    rate_hz: float
    events: tuple[str, ...]
    grid_step: int | None
    reset_reason: str

    @property
    def object_of_surface(self) -> dict[int, int]:
        """Label of the object of each surface; of the surface itself where there are no objects."""
        return {each.label: each.thing or each.label for each in self.tree if each.label}
