"""How the viewer is laid out: what is seen, where, and what it is called."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

from nurbseg.app.view.config import ViewConfig
from nurbseg.app.view.drawing import entities as entity
from nurbseg.app.view.drawing import tree as view_tree
from nurbseg.app.view.drawing.palette import STOP_COLORS
from nurbseg.segmentation.config import SegmentationConfig

_STOP_TEXTS = {
    "criterion": "red: a split was tried and did not fit better",
    "child-too-small": "orange: a side of the cut was smaller than T_p",
    "too-small": "light green: smaller than 2 T_p",
    "depth": "green: the tree's largest depth T_d was reached",
    "splits": "blue: the largest number of splits T_s was reached",
    "no-cut": "violet: no cut was found",
    "no-fit": "pink: no surface could be fitted",
    "no-points": "white: no points",
    "noise": "turquoise: so near to the sensor's noise that no split can be kept",
    "untried": "sand: no split was tried lately (live)",
    "budget": "maroon: the time for the frame (--budget-ms) was over",
}


def blueprint(*, registered: bool = True, ground_truth: bool = False, objects: bool = False) -> rrb.Blueprint:
    """Return the layout: space above, pictures beside it, tree and figures below.

    Parameters
    ----------
    registered : bool
        Whether depth and color have one camera; otherwise the color camera's own picture is shown too.
    ground_truth : bool
        Whether frames have one, which is then shown beside the segments.
    objects : bool
        Whether surfaces are merged into objects; both are then shown, the objects in front.
    """
    images = (entity.COLOR, entity.DEPTH, entity.LABELS, entity.OBJECTS, entity.GROUND_TRUTH)
    flat = [f"- {path}" for path in images]
    space = [f"+ {entity.WORLD}/**", *flat, f"- {entity.UNREGISTERED_COLOR}"]
    views = [
        rrb.Spatial3DView(
            name=name,
            origin=entity.WORLD,
            contents=[*space, f"- {hidden}"],
            eye_controls=rrb.EyeControls3D(
                position=(-0.4, -0.45, -0.15), look_target=(0.0, 0.05, 1.1), eye_up=(0.0, -1.0, 0.0)
            ),
            line_grid=False,
        )
        for name, hidden in (
            ("Surfaces, colored by residual", entity.POINTS),
            ("Points, colored by segment", entity.SURFACES),
        )
    ]
    color: rrb.View | rrb.Tabs = _picture("Color", entity.COLOR)
    if not registered:
        own = rrb.Spatial2DView(
            name="Color camera", origin=entity.COLOR_CAMERA, contents=[entity.UNREGISTERED_COLOR]
        )
        color = rrb.Tabs(_picture("Color, as seen by the depth camera", entity.COLOR), own)
    last = (
        _picture("Ground truth", entity.GROUND_TRUTH) if ground_truth else _picture("Segments", entity.LABELS)
    )
    overlay: rrb.View | rrb.Tabs = _on_color("Segments on color", entity.LABELS)
    if objects:
        surfaces = _on_color("Surfaces on color", entity.LABELS)
        overlay = rrb.Tabs(_on_color("Objects on color", entity.OBJECTS), surfaces)
    pictures = rrb.Grid(color, _picture("Depth", entity.DEPTH), overlay, last, grid_columns=2)
    tree = rrb.GraphView(
        name="Tree",
        origin=view_tree.TREE,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(0.0, view_tree.TREE_WIDTH), y_range=(0.0, view_tree.TREE_HEIGHT)
        ),
    )
    texts = rrb.Tabs(
        rrb.TextDocumentView(name="Segments", origin=view_tree.TREE_TABLE),
        rrb.TextDocumentView(name="Legend", origin=entity.LEGEND),
        rrb.TextLogView(name="Log", origin=entity.LOG),
    )
    plots = rrb.Grid(
        _plot("Rate (1/s)", entity.RATE, legend=True),
        _plot("Latency (ms)", entity.LATENCY, legend=True),
        _plot("Segments", entity.SEGMENT_COUNT, legend=False),
        _plot("Metric", entity.METRIC, legend=True),
        grid_columns=2,
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*views, pictures, column_shares=[3, 3, 4]),
            rrb.Horizontal(tree, texts, plots, column_shares=[4, 3, 3]),
            row_shares=[5, 4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),
    )


def _picture(name: str, path: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(name=name, origin=entity.CAMERA, contents=[path])


def _on_color(name: str, path: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        name=name,
        origin=entity.CAMERA,
        contents=[entity.COLOR, path],
        overrides={path: rr.SegmentationImage.from_fields(opacity=0.6)},
    )


def _plot(name: str, path: str, *, legend: bool) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin=path,
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
    """Return what the colors mean, as Markdown."""
    stops = "\n".join(f"- {_STOP_TEXTS[reason]}" for reason in STOP_COLORS)
    largest_mm = 1e3 * view.residual_max_m
    return f"""# What the colors mean

**Surfaces** are the NURBS surfaces fitted to the segments, drawn where the segment has pixels. Their color
is the distance between surface and data: blue 0 mm, cyan {largest_mm / 4:g} mm, green {largest_mm / 2:g} mm,
yellow {largest_mm * 3 / 4:g} mm, red {largest_mm:g} mm and more.

**Labels** keep their color from frame to frame. The small dots below the tree's leaves have the colors of
their labels in the pictures and on the points.

**Tree**: a segment that was cut is gray, one whose parts are not connected or came into view darker; a final
one has the color of the reason why it was not split further:

{stops}

A split is kept if the parts' {segmentation.metric.upper()} is less than {segmentation.ratio_max:g} of the
whole's (the column *ratio*). What was found in an earlier frame, say 12, is marked *@12*.
"""
