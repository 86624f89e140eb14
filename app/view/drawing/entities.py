"""Entity paths in Rerun, and their contents for a frame."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.frame import (
    Moment,
    ShownObjects,
    ViewFrame,
    object_table,
    relabelled,
    tree_table,
)
from nurbseg.app.view.drawing.outlines import outlines, strips
from nurbseg.app.view.drawing.tree import Entities, tree_entities
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.library import palette
from nurbseg.library.surface_mesh import SurfaceMesh
from nurbseg.segmentation.vocabulary import StopReason

WORLD = "world"
CAMERA = f"{WORLD}/camera"
COLOR, DEPTH, LABELS, OBJECTS = (f"{CAMERA}/image/{name}" for name in ("color", "depth", "labels", "objects"))
GROUND_TRUTH = f"{CAMERA}/ground_truth"
COLOR_CAMERA = f"{WORLD}/color_camera"
UNREGISTERED_COLOR = f"{COLOR_CAMERA}/image"
SHADED = f"{CAMERA}/image/surfaces"
POINTS, SURFACES = f"{WORLD}/points", f"{WORLD}/surfaces"
ISOLINES = f"{SURFACES}/isolines"
BOXES, NUMBERS, OUTLINES = f"{WORLD}/boxes", f"{CAMERA}/numbers", f"{CAMERA}/outlines"
#: The second color of each point: its own.
POINT_COLORS = "Photo:colors"
#: The second color of each vertex of the surfaces.
RESIDUAL_COLORS = "Residuals:colors"
RESIDUAL_SCALE = "residual_scale"
OBJECT_TABLE, TREE_TABLE, LEGEND = "objects", "splits", "legend"
RATE, LATENCY, SEGMENT_COUNT, METRIC = "plots/rate", "plots/latency", "plots/segments", "plots/metric"
EVENTS = f"{SEGMENT_COUNT}/events"
GRID_STEP = f"{RATE}/grid_step"
LOG = "log"

#: Color of isolines, and the factor that moves them toward the camera, in front of their surfaces.
_LINE_COLOR, _NEARER = (24, 26, 30), np.float32(0.998)
_STRIPS = rr.components.LineStrip3DBatch([]).as_arrow_array().type
#: Classes of regions that were not found, and of surfaces that are to be split in one of the next frames.
_NOTHING, _PENDING = 65535, 65534
#: A middle of a box is projected as if it were no nearer, meters.
_NEAREST_M = 0.1
#: Opacity of what is not sure.
_FAINT = 140
#: Number of objects with their own shades; further objects reuse them.
_SHADED_LABELS = 255


@dataclass(eq=False)
class FrameEntities:
    """One frame for all sinks."""

    frame: ViewFrame
    view: ViewConfig

    @property
    def moment(self) -> Moment:
        """Time of the frame."""
        return self.frame.moment

    @cached_property
    def entities(self) -> list[tuple[str, Any]]:
        """Entity paths with their contents."""
        return [
            *_images(self.frame, self.view),
            *_space(self.frame, self.view),
            *tree_entities(self.frame),
            *_texts(self.frame),
            *_scalars(self.frame),
        ]


def camera_entities(calibration: Calibration) -> Entities:
    """Return the cameras; logged as static, again whenever they change."""
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
    """Return what is valid for the whole recording; logged as static."""
    yield WORLD, rr.ViewCoordinates.RDF
    things = range(1, palette.LABEL_COLORS + 1)
    nothing = (_NOTHING, "not found", palette.NOTHING_COLOR)
    pending = (_PENDING, "pending: it may be wrong", palette.STOP_COLORS[StopReason.PENDING])
    named = ((label, str(label), palette.label_color(label)) for label in things)
    yield WORLD, _colored([*named, nothing, pending])
    shaded = (
        (_shaded_class(label, shade), f"surface of {label}", palette.shaded(label, shade))
        for label in range(1, _SHADED_LABELS + 1)
        for shade in range(palette.SHADES)
    )
    yield SHADED, _colored([*shaded, pending])
    scale = palette.residual_colors(np.linspace(0.0, 1.0, 256, dtype=np.float32), 1.0)
    rgb = scale.astype(">u4").view(np.uint8).reshape(-1, 4)[:, :3]
    yield RESIDUAL_SCALE, rr.Image(np.tile(rgb, (8, 1, 1)))
    yield RATE, _line("frames per second", 6)
    yield SEGMENT_COUNT, _line("segments", 0)
    yield EVENTS, _line("events", 3)
    yield GRID_STEP, _line("pixel step of the grid", 7)
    yield f"{METRIC}/worst", _line("worst segment", 3)
    yield f"{METRIC}/mean", _line("mean of all points", 1)


def _shaded_class(label: int, shade: int) -> int:
    """Return the class of a shade of an object's color, as class colors are the same in all frames."""
    return (label - 1) % _SHADED_LABELS * palette.SHADES + shade + 1


def _colored(classes: Iterable[tuple[int, str, tuple[int, int, int]]]) -> rr.AnnotationContext:
    """Return the names and colors of labels; 0 is transparent."""
    nothing = rr.AnnotationInfo(id=0, label="none", color=(0, 0, 0, 0))
    return rr.AnnotationContext(
        [nothing, *(rr.AnnotationInfo(id=label, label=name, color=color) for label, name, color in classes)]
    )


def markdown(text: str) -> rr.TextDocument:
    """Return a text in Markdown."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def stage_entities(stages: Iterable[str]) -> Entities:
    """Return how the times of the stages are plotted; logged as static."""
    for place, stage in enumerate(stages):
        yield f"{LATENCY}/{stage}", _line(stage.replace("_", " "), place)


def _line(name: str, place: int) -> rr.SeriesLines:
    return rr.SeriesLines(
        names=name, colors=palette.SERIES_COLORS[place % len(palette.SERIES_COLORS)], widths=1.8
    )


def _pinhole(camera: Intrinsics, color: tuple[int, int, int]) -> rr.Pinhole:
    # Rerun does not support lens distortion, so the frustum ignores it.
    return rr.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.15,
        color=color,
        line_width=-1.0,  # negative: points on the screen rather than meters
    )


def _images(frame: ViewFrame, view: ViewConfig) -> Entities:
    yield COLOR, _color_image(frame.color, view)
    if frame.unregistered_color is not None:
        yield UNREGISTERED_COLOR, _color_image(frame.unregistered_color, view)
    yield DEPTH, rr.DepthImage(frame.depth_mm, meter=1000.0, colormap="turbo")
    if frame.objects is None:
        yield LABELS, rr.SegmentationImage(_with_pending(frame.surfaces, frame), opacity=1.0)
    else:
        shades = palette.shades_of_surfaces(frame.object_of_surface)
        classes = {surface: _shaded_class(*shade) for surface, shade in shades.items()}
        shaded = relabelled(frame.surfaces, classes)
        yield SHADED, rr.SegmentationImage(_with_pending(shaded, frame), opacity=1.0)
        yield OBJECTS, rr.SegmentationImage(_with_pending(frame.objects, frame), opacity=1.0)
    yield OUTLINES, outlines(frame.surfaces if frame.objects is None else frame.objects)
    if frame.truth is not None and frame.truth_match is not None:
        matches = {region: match or _NOTHING for region, match in frame.truth_match.tolist() if region}
        yield GROUND_TRUTH, rr.SegmentationImage(relabelled(frame.truth, matches), opacity=1.0)


def _color_image(color: NDArray[np.uint8], view: ViewConfig) -> rr.Image | rr.EncodedImage:
    """Return an image, uncompressed for a browser alone, which would show a JPEG later than its labels."""
    if view.mode == "serve" and view.save is None:
        return rr.Image(color)
    # Rerun copies an image three times to compress it, which takes as long again.
    bgr, quality = cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, view.jpeg_quality]
    return rr.EncodedImage(contents=cv2.imencode(".jpg", bgr, quality)[1].tobytes(), media_type="image/jpeg")


def _with_pending(labels: NDArray[np.uint16], frame: ViewFrame) -> NDArray[np.uint16]:
    """Return labels of pixels, with the class of what is pending in its place."""
    pending = [
        segment.label for segment in frame.tree if segment.label and segment.stop is StopReason.PENDING
    ]
    return np.where(np.isin(frame.surfaces, pending), np.uint16(_PENDING), labels) if pending else labels


def _space(frame: ViewFrame, view: ViewConfig) -> Entities:
    if view.points_max:
        yield (
            POINTS,
            rr.Points3D(
                _rounded(frame.points_m), class_ids=frame.point_labels, radii=rr.Radius.ui_points(1.8)
            ),
        )
        photo = rr.components.ColorBatch(frame.point_colors)
        archetype, component = POINT_COLORS.split(":")
        yield POINTS, rr.DynamicArchetype(archetype, components={component: photo})
    if frame.measured is not None:
        yield BOXES, _boxes(frame.measured)
        yield NUMBERS, _numbers(frame.measured, frame.calibration.depth)
    if frame.mesh is not None:
        yield from _surfaces(frame, frame.mesh, view)


def _surfaces(frame: ViewFrame, mesh: SurfaceMesh, view: ViewConfig) -> Entities:
    shades = palette.shades_of_surfaces(frame.object_of_surface)
    colors = np.full((max(shades, default=0) + 1, 3), palette.NOTHING_COLOR, dtype=np.uint8)
    for surface, shade in shades.items():
        colors[surface] = palette.shaded(*shade)
    yield (
        SURFACES,
        rr.Mesh3D(
            vertex_positions=_rounded(mesh.vertices_m),
            vertex_normals=_rounded(mesh.normals, 64),
            triangle_indices=mesh.triangles,
            vertex_colors=palette.packed(colors)[mesh.labels],
        ),
    )
    points = rr.components.Position3DBatch(_rounded(_NEARER * mesh.vertices_m[mesh.isolines]))
    isolines = strips(points.as_arrow_array(), mesh.isoline_sizes, _STRIPS)
    yield ISOLINES, rr.LineStrips3D(isolines, colors=_LINE_COLOR, radii=rr.Radius.ui_points(0.4))
    residuals = rr.components.ColorBatch(palette.residual_colors(mesh.residuals_m, view.residual_max_m))
    archetype, component = RESIDUAL_COLORS.split(":")
    yield SURFACES, rr.DynamicArchetype(archetype, components={component: residuals})


def _boxes(measured: ShownObjects) -> rr.Boxes3D:
    """Return the boxes of objects with their numbers and sizes; those of what is not sure are faint."""
    colors = [
        (*palette.label_color(label), 255 if sure else _FAINT)
        for label, sure in zip(measured.labels.tolist(), measured.sure.tolist(), strict=True)
    ]
    return rr.Boxes3D(
        centers=measured.center_m.astype(np.float32),
        half_sizes=(measured.size_m / 2).astype(np.float32),
        quaternions=measured.turn.astype(np.float32),
        colors=colors,
        labels=measured.names,
        show_labels=True,
        radii=rr.Radius.ui_points(1.0),
        # Filled ones would hide the scene.
        fill_mode=rr.components.FillMode.MajorWireframe,
    )


def _numbers(measured: ShownObjects, camera: Intrinsics) -> rr.Points2D:
    """Return the numbers of objects where the middles of their boxes are in the image."""
    distance_m = np.maximum(measured.center_m[:, 2:], _NEAREST_M)
    places = measured.center_m[:, :2] / distance_m * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return rr.Points2D(
        places.astype(np.float32),
        colors=palette.paler(measured.labels),
        labels=[name.partition(" ")[0] for name in measured.names],
        show_labels=True,
        radii=rr.Radius.ui_points(2.0),
    )


def _rounded(values: NDArray[np.float32], per_unit: int = 1024) -> NDArray[np.float32]:
    """Return values rounded to what can be seen, which makes a saved frame a third smaller."""
    return np.asarray(np.rint(values * np.float32(per_unit)) / np.float32(per_unit))


def _texts(frame: ViewFrame) -> Entities:
    """Return the tables, and log lines on events of segments and a reset of the tree."""
    if frame.merges is not None:
        yield OBJECT_TABLE, markdown(object_table(frame))
    yield TREE_TABLE, markdown(tree_table(frame))
    if frame.events:
        yield LOG, rr.TextLog("; ".join(frame.events), level="INFO")
    if frame.reset_reason:
        yield LOG, rr.TextLog(f"segmented from scratch: {frame.reset_reason}", level="INFO")


def _scalars(frame: ViewFrame) -> Entities:
    if frame.rate_hz > 0:
        yield RATE, rr.Scalars(frame.rate_hz)
    for stage, stage_ms in frame.elapsed_ms.items():
        yield f"{LATENCY}/{stage}", rr.Scalars(stage_ms)
    leaves = [segment for segment in frame.tree if segment.label is not None and segment.has_surface]
    yield SEGMENT_COUNT, rr.Scalars(len(leaves))
    if leaves:
        values = [leaf.value or 0.0 for leaf in leaves]
        weights = [max(leaf.pixels, 1) for leaf in leaves]
        yield f"{METRIC}/worst", rr.Scalars(max(values))
        yield f"{METRIC}/mean", rr.Scalars(np.average(values, weights=weights))
    if frame.grid_step is not None:
        yield GRID_STEP, rr.Scalars(frame.grid_step)
    yield EVENTS, rr.Scalars(len(frame.events))
