"""What a frame's result looks like to Rerun: entity paths and their contents."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from nurbseg.app.palette import (
    LABEL_COLORS,
    SERIES_COLORS,
    label_colors,
    residual_colors,
)
from nurbseg.app.surface_mesh import surface_mesh
from nurbseg.app.view_config import ViewConfig
from nurbseg.app.view_tree import Entities, tree_entities
from nurbseg.app.worker import FrameResult
from nurbseg.drivers.frame import Calibration, Intrinsics
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.identity import Event, event_text
from nurbseg.segmentation.live import Revision
from nurbseg.segmentation.tree import SegmentationTree

WORLD = "world"
CAMERA = f"{WORLD}/camera"
COLOR, DEPTH, LABELS, OBJECTS = (f"{CAMERA}/image/{name}" for name in ("color", "depth", "labels", "objects"))
GROUND_TRUTH = f"{CAMERA}/ground_truth"
COLOR_CAMERA = f"{WORLD}/color_camera"
UNREGISTERED_COLOR = f"{COLOR_CAMERA}/image"
POINTS, SURFACES = f"{WORLD}/points", f"{WORLD}/surfaces"
LEGEND = "legend"
RATE, LATENCY, SEGMENT_COUNT, METRIC = "plots/rate", "plots/latency", "plots/segments", "plots/metric"
EVENTS = f"{SEGMENT_COUNT}/events"
GRID_STEP = f"{RATE}/grid_step"
LOG = "log"


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

    def set_on(self, stream: rr.RecordingStream) -> None:
        """Make it the time of what this thread logs next."""
        stream.set_time("frame", sequence=self.frame)
        if self.device_ns is None:
            return
        if self.since_epoch:
            stream.set_time("device_time", timestamp=np.datetime64(self.device_ns, "ns"))
        else:
            stream.set_time("device_time", duration=np.timedelta64(self.device_ns, "ns"))


@dataclass(slots=True, eq=False)
class FrameEntities:
    """One frame for all sinks: built by the first thread that needs it, shared with the others.

    Parameters
    ----------
    result : FrameResult
        The frame.
    elapsed_ms : mapping of str to float
        Time that each stage took until now, milliseconds; a copy, since the run may go on timing.
    moment : Moment
        When it was.
    rate_hz : float
        Frames segmented in a second; 0 where it is not known yet.
    view : ViewConfig
        How fine everything is drawn.
    segmentation : SegmentationConfig
        Names the metric.
    """

    result: FrameResult
    elapsed_ms: Mapping[str, float]
    moment: Moment
    rate_hz: float
    view: ViewConfig
    segmentation: SegmentationConfig
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _built: list[tuple[str, Any]] | None = None

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages that were timed."""
        return tuple(self.elapsed_ms)

    @property
    def calibration(self) -> Calibration:
        """Of the frame's cameras."""
        return self.result.frame.calibration

    def entities(self) -> Entities:
        """Return paths and what is logged there."""
        with self._lock:
            if self._built is None:
                self._built = [
                    *_images(self.result, self.view),
                    *_space(self.result, self.view),
                    *tree_entities(self.result, self.segmentation.metric),
                    *_scalars(self.result.tree, self.elapsed_ms, self.rate_hz, self.segmentation.metric),
                    *event_entities(self.result.events),
                    *_revision_entities(self.result.revision),
                ]
            return self._built


def camera_entities(calibration: Calibration) -> Entities:
    """Return the cameras; logged static, again whenever they change."""
    yield CAMERA, _pinhole(calibration.depth, (250, 190, 60))
    if not calibration.is_registered:
        color_from_depth = calibration.color_from_depth
        yield (
            COLOR_CAMERA,
            rr.Transform3D(
                translation=color_from_depth[:3, 3],
                mat3x3=color_from_depth[:3, :3],
                relation=rr.TransformRelation.ChildFromParent,
            ),
        )
        yield COLOR_CAMERA, _pinhole(calibration.color, (90, 170, 250))


def opening_entities() -> Entities:
    """Return what holds for the whole recording; logged static."""
    yield WORLD, rr.ViewCoordinates.RDF
    colors = label_colors()
    yield (
        WORLD,
        rr.AnnotationContext(
            [
                rr.AnnotationInfo(id=0, label="none", color=(0, 0, 0, 0)),
                *(
                    rr.AnnotationInfo(id=label, label=str(label), color=tuple(map(int, color)))
                    for label, color in zip(range(1, LABEL_COLORS + 1), colors, strict=True)
                ),
            ]
        ),
    )
    yield RATE, _line("frames per second", 2)
    yield SEGMENT_COUNT, _line("segments", 0)
    yield EVENTS, _line("events", 3)
    yield GRID_STEP, _line("pixel step of the grid", 7)
    yield f"{METRIC}/worst", _line("worst segment", 3)
    yield f"{METRIC}/mean", _line("mean of all points", 1)


def stage_entities(stages: Iterable[str]) -> Entities:
    """Return how the lines of the stages' times are drawn; logged static."""
    for place, stage in enumerate(stages):
        yield f"{LATENCY}/{stage}", _line(stage.replace("_", " "), place)


def _line(name: str, place: int) -> rr.SeriesLines:
    return rr.SeriesLines(names=name, colors=SERIES_COLORS[place % len(SERIES_COLORS)], widths=1.8)


def _pinhole(camera: Intrinsics, color: tuple[int, int, int]) -> rr.Pinhole:
    # Rerun knows no lens distortion: the frustum is that of the ideal camera.
    return rr.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.15,
        color=color,
        line_width=-1.0,  # negative: points on the screen rather than metres
    )


def _images(result: FrameResult, view: ViewConfig) -> Entities:
    frame = result.frame
    color = frame.color if frame.calibration.is_registered else result.cloud.color
    yield COLOR, rr.Image(color).compress(jpeg_quality=view.jpeg_quality)
    if not frame.calibration.is_registered:
        yield UNREGISTERED_COLOR, rr.Image(frame.color).compress(jpeg_quality=view.jpeg_quality)
    yield DEPTH, rr.DepthImage(frame.depth_mm, meter=1000.0, colormap="turbo")
    yield LABELS, rr.SegmentationImage(result.surface_image(), opacity=1.0)
    if result.tree.objects:
        yield OBJECTS, rr.SegmentationImage(result.object_image(), opacity=1.0)
    if frame.labels is not None:
        yield GROUND_TRUTH, rr.SegmentationImage(frame.labels, opacity=1.0)


def _space(result: FrameResult, view: ViewConfig) -> Entities:
    # Meshes go with the tree's own labels; what is seen bears those that last.
    labels = result.tree.label_image()
    pixels = labels.size
    if view.points_max:
        step = max(1, int(np.ceil(np.sqrt(pixels / view.points_max))))
        answer = result.labels()[::step, ::step]
        shown = answer > 0
        yield (
            POINTS,
            rr.Points3D(
                result.cloud.points_m[::step, ::step][shown],
                class_ids=answer[shown],
                radii=rr.Radius.ui_points(1.8),
            ),
        )
    mesh = surface_mesh(result.tree, labels, view.mesh_step_px * np.sqrt(pixels / (640 * 480)))
    yield (
        SURFACES,
        rr.Mesh3D(
            vertex_positions=mesh.vertices_m,
            vertex_normals=mesh.normals,
            triangle_indices=mesh.triangles,
            vertex_colors=residual_colors(mesh.residuals_m, view.residual_max_m),
        ),
    )


def _scalars(
    tree: SegmentationTree, elapsed_ms: Mapping[str, float], rate_hz: float, metric: Metric
) -> Entities:
    if rate_hz > 0:
        yield RATE, rr.Scalars(rate_hz)
    for stage, stage_ms in elapsed_ms.items():
        yield f"{LATENCY}/{stage}", rr.Scalars(stage_ms)
    leaves = [leaf for leaf in tree.leaves() if leaf.fit.surface is not None]
    yield SEGMENT_COUNT, rr.Scalars(len(leaves))
    values = np.array([leaf.fit.values.get(metric, 0.0) for leaf in leaves])
    if values.size:
        weights = np.array([leaf.pixels.size for leaf in leaves], dtype=float)
        yield f"{METRIC}/worst", rr.Scalars(values.max())
        yield f"{METRIC}/mean", rr.Scalars(np.average(values, weights=np.maximum(weights, 1.0)))


def event_entities(events: Sequence[Event]) -> Entities:
    """Return what happened to segments between two frames: a number, and a line of the log for all."""
    yield EVENTS, rr.Scalars(len(events))
    if events:
        yield LOG, rr.TextLog("; ".join(map(event_text, events)), level="INFO")


def _revision_entities(revision: Revision | None) -> Entities:
    """Return what was done to the live tree: how fine it was worked, and when it was begun anew."""
    if revision is None:
        return
    yield GRID_STEP, rr.Scalars(revision.step)
    if revision.cold:
        yield LOG, rr.TextLog(f"segmented anew: {revision.cold}", level="INFO")


__all__ = [
    "CAMERA",
    "Entities",
    "FrameEntities",
    "Moment",
    "camera_entities",
    "event_entities",
    "opening_entities",
    "stage_entities",
]
