"""Layout of the viewer, and its legend."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import VisualizerComponentMapping

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing import entities as entity
from nurbseg.app.view.drawing import tree as tree_drawing
from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.library.palette import STOPS
from nurbseg.segmentation.config import SegmentationConfig

#: Positions of the eye and its target in the depth camera's frame, as multiples of the scene's distance.
_EYE, _TARGET = (-0.36, -0.42, -0.4), (-0.1, 0.02, 1.0)


def blueprint(frame: ViewFrame, view: ViewConfig, timeline: str = "frame") -> rrb.Blueprint:
    """Return the layout for frames of this kind: 3D and images above; tree, tables and plots below.

    If depth and color are not registered, the color camera's own image is shown, too. "compact" shows less
    at once, with the rest in tabs. The eye's position depends on the scene's distance; the viewer follows
    `timeline` to its end.
    """
    objects = frame.objects is not None
    scene, surfaces, points, residuals = _spaces(frame, view)
    color: rrb.View | rrb.Tabs = _picture("Color", entity.COLOR)
    if frame.unregistered_color is not None:
        own = rrb.Spatial2DView(
            name="Color camera", origin=entity.COLOR_CAMERA, contents=[entity.UNREGISTERED_COLOR]
        )
        color = rrb.Tabs(_picture("Color, as seen by the depth camera", entity.COLOR), own)
    depth = _picture("Depth", entity.DEPTH)
    found = _on_color("Objects on color" if objects else "Segments on color")
    rest = [_picture("Ground truth", entity.GROUND_TRUTH)] if frame.truth is not None else []
    if objects:
        rest += [_picture("Surfaces", entity.SHADED), _picture("Labels", entity.OBJECTS)]
    else:
        rest += [_picture("Segments", entity.LABELS)]
    tree = _graph("Tree", tree_drawing.TREE)
    trees = rrb.Tabs(_graph("Tree by object", tree_drawing.OBJECT_TREE), tree) if objects else tree
    texts = (
        rrb.TextDocumentView(name="Objects" if objects else "Segments", origin=entity.OBJECT_TABLE),
        rrb.TextDocumentView(name="Splits", origin=entity.TREE_TABLE),
        rrb.TextDocumentView(name="Legend", origin=entity.LEGEND),
        rrb.TextLogView(name="Log", origin=entity.LOG),
    )
    speed = _plot("Rate (1/s), latency (ms)", "plots", [entity.RATE, f"{entity.LATENCY}/**"])
    counts = _plot("Segments, events", entity.SEGMENT_COUNT)
    mean = _plot("Mean metric", f"{entity.METRIC}/mean", legend=False)
    worst = _plot("Worst metric", f"{entity.METRIC}/worst", legend=False)
    if view.layout == "compact":
        above = rrb.Horizontal(
            rrb.Tabs(scene, surfaces, points, residuals), rrb.Tabs(found, *rest, color, depth)
        )
        below = rrb.Horizontal(trees, rrb.Tabs(*texts, speed, counts, mean, worst))
    else:
        spaces = rrb.Tabs(scene, surfaces, points, residuals)
        above = rrb.Horizontal(spaces, rrb.Tabs(found, color, depth, *rest), column_shares=[1, 1])
        figures = rrb.Vertical(rrb.Horizontal(counts, speed), rrb.Horizontal(mean, worst), name="Plots")
        below = rrb.Horizontal(rrb.Tabs(*texts, figures), trees, column_shares=[1, 1])
    return rrb.Blueprint(
        rrb.Vertical(above, below, row_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following"),
    )


def _spaces(frame: ViewFrame, view: ViewConfig) -> tuple[rrb.View, rrb.View, rrb.View, rrb.Container]:
    """Return the 3D views of the scene in its own colors, of surfaces, points and residuals."""
    colored_by = "segment" if frame.objects is None else "object"
    depth_mm = frame.depth_mm[frame.depth_mm > 0]
    distance_m = float(np.median(depth_mm)) / 1000.0 if depth_mm.size else 1.0
    by_residual = rr.Mesh3D.from_fields().visualizer(
        mappings=[
            VisualizerComponentMapping(
                "Mesh3D:vertex_colors", "SourceComponent", source_component=entity.RESIDUAL_COLORS
            )
        ]
    )
    by_photo = rr.Points3D.from_fields().visualizer(
        mappings=[
            VisualizerComponentMapping(
                "Points3D:colors", "SourceComponent", source_component=entity.POINT_COLORS
            )
        ]
    )
    in_scene = [entity.POINTS, entity.BOXES, entity.CAMERA]
    shown: tuple[tuple[str, list[str], dict[Any, Any]], ...] = (
        ("Scene with boxes of objects", in_scene, {entity.POINTS: by_photo}),
        (f"Surfaces, colored by {colored_by}", [f"{entity.SURFACES}/**"], {}),
        (f"Points, colored by {colored_by}", [entity.POINTS], {}),
        ("Surfaces, colored by residual", [entity.SURFACES], {entity.SURFACES: by_residual}),
    )
    scene, surfaces, points, residuals = (
        rrb.Spatial3DView(
            name=name,
            origin=entity.WORLD,
            contents=paths,
            eye_controls=rrb.EyeControls3D(
                position=tuple(distance_m * each for each in _EYE),
                look_target=tuple(distance_m * each for each in _TARGET),
                eye_up=(0.0, -1.0, 0.0),
            ),
            line_grid=False,
            overrides=overrides,
        )
        for name, paths, overrides in shown
    )
    largest_mm = 1e3 * view.residual_max_m
    scale = rrb.Spatial2DView(name=f"0 to {largest_mm:g} mm and more", origin=entity.RESIDUAL_SCALE)
    return scene, surfaces, points, rrb.Vertical(residuals, scale, row_shares=[8, 1], name="Residuals")


def _graph(name: str, path: str) -> rrb.GraphView:
    return rrb.GraphView(
        name=name,
        origin=path,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(0.0, tree_drawing.TREE_WIDTH), y_range=(0.0, tree_drawing.TREE_HEIGHT)
        ),
    )


def _picture(name: str, path: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(name=name, origin=entity.CAMERA, contents=[path])


def _on_color(name: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        name=name, origin=entity.CAMERA, contents=[entity.COLOR, entity.OUTLINES, entity.NUMBERS]
    )


def _plot(
    name: str, path: str, contents: Sequence[str] = ("$origin/**",), *, legend: bool = True
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin=path,
        contents=contents,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
        time_ranges=[
            rrb.VisibleTimeRange(
                "frame",
                start=rrb.TimeRangeBoundary.cursor_relative(seq=-300),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
        ],
    )


def legend(view: ViewConfig, segmentation: SegmentationConfig) -> str:
    """Return the meaning of the colors, as Markdown."""
    stops = "\n".join(f"- {text}" for _, text in STOPS.values())
    largest_mm = 1e3 * view.residual_max_m
    return f"""# What the colors mean

**Objects** have one color each, in all pictures, in 3D and in the tree, and keep it from frame to frame.
Their **surfaces**, the NURBS surfaces fitted to the segments, are shades of it. A region of the ground truth
has the color of what overlaps it most; gray regions were not found.

**Residuals** are the distances between surface and data: blue 0 mm, cyan {largest_mm / 4:g} mm,
green {largest_mm / 2:g} mm, yellow {largest_mm * 3 / 4:g} mm, red {largest_mm:g} mm and more.

**Tree by object**: a part of the tree within one object is drawn as one node in its color.

**Tree**: the dots below the leaves have the colors of their surfaces. A segment that was cut is gray; one
whose parts are not connected or came into view is darker. A leaf has the color of the reason why it was
not split further:

{stops}

A split is kept if the parts' {segmentation.metric.upper()} is less than {segmentation.ratio_max:g} of the
whole's (the column *ratio*). What was found in an earlier frame, say 12, is marked *@12*.
"""
