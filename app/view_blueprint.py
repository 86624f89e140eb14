"""How the viewer is laid out: what is seen, where, and what it is called."""

from __future__ import annotations

import rerun.blueprint as rrb

from nurbseg.app import view_entities as entity
from nurbseg.app.palette import INNER_COLOR, STOP_COLORS
from nurbseg.app.view_config import ViewConfig
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
}


def blueprint() -> rrb.Blueprint:
    """Return the layout: space above, pictures beside it, tree and figures below."""
    flat = [f"- {path}" for path in (entity.COLOR, entity.DEPTH, entity.LABELS, entity.GROUND_TRUTH)]
    eye = rrb.EyeControls3D(
        position=(-0.55, -0.75, -0.7), look_target=(0.0, 0.0, 1.2), eye_up=(0.0, -1.0, 0.0)
    )
    space = [f"+ {entity.WORLD}/**", *flat, f"- {entity.UNREGISTERED_COLOR}"]
    surfaces = rrb.Spatial3DView(
        name="Surfaces, colored by residual",
        origin=entity.WORLD,
        contents=[*space, f"- {entity.POINTS}"],
        eye_controls=eye,
        line_grid=False,
    )
    points = rrb.Spatial3DView(
        name="Points, colored by segment",
        origin=entity.WORLD,
        contents=[*space, f"- {entity.SURFACES}"],
        eye_controls=eye,
        line_grid=False,
    )
    pictures = rrb.Grid(
        _picture("Color", entity.COLOR),
        _picture("Depth", entity.DEPTH),
        _picture("Segments", entity.LABELS),
        rrb.Spatial2DView(
            name="Segments on color",
            origin=entity.CAMERA,
            contents=[entity.COLOR, entity.LABELS],
            overrides={entity.LABELS: rrb.VisualizableArchetype()} if False else None,
        ),
        grid_columns=2,
    )
    tree = rrb.GraphView(
        name="Tree",
        origin="tree",
        contents=["tree/**"],
        visual_bounds=rrb.VisualBounds2D(
            x_range=(0.0, entity.TREE_WIDTH), y_range=(-10.0, entity.TREE_HEIGHT + 10.0)
        ),
    )
    texts = rrb.Tabs(
        rrb.TextDocumentView(name="Segments", origin=entity.TREE_TABLE),
        rrb.TextDocumentView(name="Legend", origin=entity.LEGEND),
        rrb.TextLogView(name="Log", origin=entity.LOG),
    )
    plots = rrb.Grid(
        _plot("Rate (1/s)", entity.RATE),
        _plot("Latency (ms)", entity.LATENCY),
        _plot("Segments", entity.SEGMENT_COUNT),
        _plot("Metric", entity.METRIC),
        grid_columns=2,
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(surfaces, points, pictures, column_shares=[3, 3, 4]),
            rrb.Horizontal(tree, texts, plots, column_shares=[4, 3, 3]),
            row_shares=[5, 4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),
    )


def _picture(name: str, path: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(name=name, origin=entity.CAMERA, contents=[path])


def _plot(name: str, path: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin=path,
        plot_legend=rrb.PlotLegend(visible=True),
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

**Tree**: a split segment is gray; a final one has the color of the reason why it was not split further:

{stops}

A split is kept if the parts' {segmentation.metric.upper()} is less than {segmentation.ratio_max:g} of the
whole's (the column *ratio*).
"""


__all__ = ["INNER_COLOR", "blueprint", "legend"]
