"""The part of a frame's result that views show: images, points, a mesh, texts and tables."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Calibration
from nurbseg.library.palette import color_name
from nurbseg.library.surface_mesh import SurfaceMesh
from nurbseg.segmentation.config import METRIC_UNITS, Metric
from nurbseg.segmentation.vocabulary import TRIED, Division, StopReason, display_name


@dataclass(frozen=True, slots=True)
class Moment:
    """Time of a frame, or of a log line."""

    #: Number of the frame.
    frame: int
    #: Device clock, nanoseconds; None before the first frame.
    device_ns: int | None


@dataclass(frozen=True, slots=True)
class TreeNode:
    """A segment of the tree, as it is drawn and listed."""

    name: str
    children: tuple[str, ...]
    #: Label of a leaf; None for other segments.
    label: int | None
    #: Label of a leaf's object; None if surfaces are not merged into objects.
    thing: int | None
    pixels: int
    #: The deciding metric; None if it was not measured.
    value: float | None
    ratio: float | None
    stop: StopReason | None
    division: Division | None
    has_surface: bool
    #: Frames in which the value, and the ratio or stop reason, were determined; None for this frame.
    measured: int | None
    judged: int | None


@dataclass(frozen=True, slots=True, eq=False)
class ShownObjects:
    """The measured objects of a frame, in the order of labels; without a class for each, to be sent fast."""

    labels: NDArray[np.uint16]
    #: (M,) meters from the camera to the mean of its points.
    distance_m: NDArray[np.float64]
    #: Its box: (M, 3) meters, and (M, 4) quaternion x, y, z, w.
    center_m: NDArray[np.float64]
    size_m: NDArray[np.float64]
    turn: NDArray[np.float64]
    #: (M,) meters, NaN without a surface.
    fit_error_m: NDArray[np.float64]
    #: (M,) whether it fits, is seen and not pending.
    sure: NDArray[np.bool_]

    @property
    def names(self) -> list[str]:
        """Its label and size in centimeters; only a question mark if it is not sure, as is its size then."""
        return [
            f"{label}  {size_text(size)}" if sure else f"{label}?"
            for label, sure, size in zip(self.labels.tolist(), self.sure.tolist(), self.size_m, strict=True)
        ]


def size_text(size_m: NDArray[np.float64]) -> str:
    """Return the sides of a box as ``23 x 14 x 7 cm``."""
    return " x ".join(f"{100 * side:.0f}" for side in size_m.tolist()) + " cm"


def relabelled(labels: NDArray[np.uint16], new_labels: Mapping[int, int]) -> NDArray[np.uint16]:
    """Return new labels, 0 for unlisted ones; without Numba, which is slow to import."""
    table = np.zeros(max(new_labels, default=0) + 2, dtype=np.uint16)
    table[[*new_labels]] = [*new_labels.values()]
    return table.take(labels, mode="clip")


@dataclass(frozen=True, slots=True, eq=False)
class ViewFrame:
    """A frame as it is shown; label images have 0 for no label."""

    moment: Moment
    #: Name in the source; may be empty.
    name: str
    metric: Metric
    calibration: Calibration
    #: (H, W, 3) RGB in the depth camera's image.
    color: NDArray[np.uint8]
    #: (h, w, 3) RGB as captured, if that is another image.
    unregistered_color: NDArray[np.uint8] | None
    #: (H, W) millimeters, 0 for no depth.
    depth_mm: NDArray[np.uint16]
    #: (H, W) labels of surfaces, of objects if there are any, and of the ground truth.
    surfaces: NDArray[np.uint16]
    objects: NDArray[np.uint16] | None
    truth: NDArray[np.uint16] | None
    #: (R, 2) regions of the ground truth, each with the object or surface that overlaps it most; 0 for none.
    truth_match: NDArray[np.uint16] | None
    #: (N, 3) some of the points, meters, and (N,) the object or surface of each.
    points_m: NDArray[np.float32]
    point_labels: NDArray[np.uint16]
    #: (N, 3) RGB of each of them.
    point_colors: NDArray[np.uint8]
    #: The measured objects; None in a frame that is not shown in full.
    measured: ShownObjects | None
    #: Its labels are those of `surfaces`; None in a frame that is not shown in full.
    mesh: SurfaceMesh | None
    #: Depth first.
    tree: tuple[TreeNode, ...]
    #: For each object of several surfaces, which were merged and why; None like `measured`.
    merges: tuple[str, ...] | None
    #: Time of each stage, milliseconds.
    elapsed_ms: Mapping[str, float]
    #: Frames shown per second; 0 if unknown.
    rate_hz: float
    #: What happened to segments since the previous frame.
    events: tuple[str, ...]
    #: Step of the live tree's grid, pixels.
    grid_step: int | None
    #: Why the live tree was reset; empty if it was not.
    reset_reason: str

    @property
    def object_of_surface(self) -> dict[int, int]:
        """Label of each surface's object, or of the surface itself if there are no objects."""
        return {segment.label: segment.thing or segment.label for segment in self.tree if segment.label}


def object_table(frame: ViewFrame) -> str:
    """Return the objects of a frame, or its segments where there are no objects, the nearest first.

    A question mark stands beside the number of what is not sure. Below the table are the reasons why surfaces
    were merged.
    """
    kind = "segments" if frame.objects is None else "objects"
    pixels, surfaces = Counter[int](), Counter[int]()
    for segment in frame.tree:
        if segment.label:
            thing = frame.object_of_surface[segment.label]
            pixels[thing] += segment.pixels
            surfaces[thing] += 1
    lines = [
        f"**{_name(frame)}**: {len(surfaces)} {kind}\n",
        f"| {kind[:-1]} | color | distance (m) | size (cm) | fit error (mm) | pixels | surfaces |",
        "|---:|---|---:|---:|---:|---:|---:|",
    ]
    if (shown := frame.measured) is not None:
        for n in np.argsort(shown.distance_m, kind="stable").tolist():
            label = int(shown.labels[n])
            cells = (
                f"{label}{'' if shown.sure[n] else '?'}",
                color_name(label),
                f"{shown.distance_m[n]:.2f}",
                size_text(shown.size_m[n]).removesuffix(" cm"),
                f"{1e3 * shown.fit_error_m[n]:.1f}" if np.isfinite(shown.fit_error_m[n]) else "",
                f"{pixels[label]:,}",
                str(surfaces[label]),
            )
            lines.append(f"| {' | '.join(cells)} |")
    if frame.merges:
        lines += ["", "Merged surfaces:", "", *(f"- {merge}" for merge in frame.merges)]
    return "\n".join(lines)


def tree_table(frame: ViewFrame) -> str:
    """Return the tree of a frame, a row for each segment.

    Values from an earlier frame are marked with its number: ``0.87 @12``.
    """
    nodes, moment = frame.tree, frame.moment.frame
    leaves = sum(node.label is not None for node in nodes)
    value = f"{frame.metric.upper()} ({METRIC_UNITS[frame.metric]})"
    lines = [
        f"**{_name(frame)}**: {leaves} final segments of {len(nodes)}\n",
        f"| segment | label | pixels | {value} | ratio | divided or stopped by |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for node in nodes:
        cells = (
            display_name(node.name),
            "" if node.label is None else str(node.label),
            f"{node.pixels:,}",
            "" if node.value is None else f"{node.value:.3g}" + _mark(node.measured, moment),
            "" if node.ratio is None else f"{node.ratio:.3f}" + _mark(node.judged, moment),
            _reason(node, moment),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _name(frame: ViewFrame) -> str:
    return frame.name or f"frame {frame.moment.frame}"


def _mark(found: int | None, frame: int) -> str:
    return "" if found in (None, frame) else f" @{found}"


def _reason(node: TreeNode, frame: int) -> str:
    """Return how a node is divided or why it is a leaf, and the frame of the trial that decided this."""
    by_present_values = node.stop is not None and node.stop not in TRIED
    return str(node.stop or node.division) + ("" if by_present_values else _mark(node.judged, frame))
