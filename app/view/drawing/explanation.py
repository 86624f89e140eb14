"""The explanation of a frame in Rerun: a step at each time of the timeline ``split``."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from nurbseg.app.view.drawing.entities import markdown
from nurbseg.common.files import replacing
from nurbseg.library.explanation.explanation import Explanation
from nurbseg.library.explanation.panels import spread
from nurbseg.library.explanation.steps import Part, Step
from nurbseg.library.explanation.tree import marks
from nurbseg.library.meshing import surface_mesh
from nurbseg.library.palette import residual_colors
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.vocabulary import display_name

TIMELINE = "split"
SIDES, WHOLE, PARTS, TREE, WHY = (f"split/{name}" for name in ("sides", "whole", "parts", "tree", "why"))
WORLD = "split/world"
SURFACE, SURFACES, POINTS = (f"{WORLD}/{name}" for name in ("whole", "parts", "points"))

#: Size of the tree's drawing, and spacing of the vertices of surfaces, pixels.
_TREE_SIZE, _MESH_STEP_PX = (620.0, 400.0), 4.0
_JPEG_QUALITY = 90
#: Every so many rows and columns of points are shown behind the surfaces.
_POINT_STEP = 3
_EDGE_COLOR, _FAINT = (120, 130, 144), 60


def save_explanation(explanation: Explanation, path: Path) -> None:
    """Write an explanation as a Rerun recording, with its layout.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    # Images are private.
    with replacing(path, mode=0o600) as file, rr.RecordingStream("nurbseg-explanation") as recording:
        recording.save(f"/proc/self/fd/{file.fileno()}", default_blueprint=explanation_blueprint(explanation))
        recording.send_recording_name(explanation.title)
        recording.log(WORLD, rr.ViewCoordinates.RDF, static=True)
        cloud = explanation.cloud
        seen = (np.s_[::_POINT_STEP, ::_POINT_STEP], cloud.valid[::_POINT_STEP, ::_POINT_STEP])
        points, colors = (each[seen[0]][seen[1]] for each in (cloud.points_m, cloud.color))
        recording.log(POINTS, rr.Points3D(points, colors=colors // 2, radii=-1.0), static=True)
        for step in explanation.steps:
            recording.set_time(TIMELINE, sequence=step.number)
            _log_step(recording, explanation, step)
        recording.flush()
        recording.disconnect()


def _log_step(recording: rr.RecordingStream, explanation: Explanation, step: Step) -> None:
    drawn = explanation.panels(step)
    for path, image in ((SIDES, drawn.sides), (WHOLE, drawn.whole), (PARTS, drawn.parts)):
        recording.log(path, rr.Image(image).compress(jpeg_quality=_JPEG_QUALITY))
    for path, parts in ((SURFACE, (step.whole,)), (SURFACES, step.parts)):
        recording.log(path, _mesh(explanation, parts, drawn.largest_m))
    recording.log(WHY, markdown(_told(step, drawn.largest_m)))
    nodes, edges = marks(explanation.tree, explanation.steps, step, *_TREE_SIZE)
    alphas = [255 if node.is_there else _FAINT for node in nodes]
    recording.log(
        f"{TREE}/edges",
        rr.LineStrips2D(
            [[(one.x, one.y), (part.x, part.y)] for one, part in edges],
            colors=[(*_EDGE_COLOR, 255 if part.is_there else _FAINT) for _, part in edges],
            radii=1.0,
        ),
    )
    recording.log(
        f"{TREE}/nodes",
        rr.Points2D(
            [(node.x, node.y) for node in nodes],
            colors=[(*node.color, alpha) for node, alpha in zip(nodes, alphas, strict=True)],
            radii=[node.radius * (1.5 if node.is_now else 1.0) for node in nodes],
            labels=[node.label if node.is_there else "" for node in nodes],
            show_labels=True,
            draw_order=10.0,
        ),
    )


def _told(step: Step, largest_m: float) -> str:
    """Return what was decided, with the numbers behind, as Markdown."""
    lines = [
        f"# {step.sentence[0].upper()}{step.sentence[1:]}",
        f"**{display_name(step.name)}**, {step.kind}",
        "",
    ]
    if step.verdict:
        lines += [
            f"{step.metric.upper()} {step.verdict}",
            "",
            f"- one surface: {step.whole.told(step.metric)}",
        ]
    for number, part in enumerate(step.parts, start=1):
        name = f"part {number}" if part.name is None else display_name(part.name)
        lines.append(f"- {name}: {part.told(step.metric)}")
    lines += [f"- {each}" for each in step.evidence]
    return "\n".join((*lines, "", f"Distances: blue 0, red {1e3 * largest_m:g} mm and more."))


def _mesh(explanation: Explanation, parts: Sequence[Part], largest_m: float) -> rr.Mesh3D | rr.Clear:
    """Return the surfaces of parts, colored by residual."""
    fitted = [part.fit for part in parts if part.fit.surface is not None]
    labels = np.zeros(explanation.tree.shape, dtype=np.uint16)
    for label, fit in enumerate(fitted, start=1):
        spread(labels, fit.pixels, label, explanation.grid_step)
    leaves = tuple(Segment("", None, (), fit.pixels, fit, None, None, None) for fit in fitted)
    mesh = surface_mesh(SegmentationTree(leaves, labels.shape), labels, _MESH_STEP_PX)
    if not mesh.triangles.size:
        return rr.Clear(recursive=False)
    return rr.Mesh3D(
        vertex_positions=mesh.vertices_m,
        vertex_normals=mesh.normals,
        triangle_indices=mesh.triangles,
        vertex_colors=residual_colors(mesh.residuals_m, largest_m),
    )


def explanation_blueprint(explanation: Explanation) -> rrb.Blueprint:
    """Return the layout: the parts, one surface and several, above; the reason and the tree below."""
    points_m = explanation.cloud.points_m[explanation.cloud.valid]
    distance_m = float(np.median(points_m[:, 2])) if points_m.size else 1.0
    eye = rrb.EyeControls3D(
        position=(-0.1 * distance_m, -0.3 * distance_m, -0.05 * distance_m),
        look_target=(0.0, 0.0, distance_m),
        eye_up=(0.0, -1.0, 0.0),
    )
    spaces = [
        rrb.Spatial3DView(name=name, origin=WORLD, contents=[path, POINTS], eye_controls=eye, line_grid=False)
        for name, path in (("A surface for each part", SURFACES), ("One surface", SURFACE))
    ]
    pictures = [
        rrb.Spatial2DView(name=name, origin=path)
        for name, path in (
            ("Parts", SIDES),
            ("One surface: distances", WHOLE),
            ("A surface for each part: distances", PARTS),
        )
    ]
    bounds = rrb.VisualBounds2D(x_range=(0.0, _TREE_SIZE[0]), y_range=(0.0, _TREE_SIZE[1]))
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*pictures),
            rrb.Horizontal(
                rrb.TextDocumentView(name="Why", origin=WHY),
                rrb.Tabs(*spaces),
                rrb.Spatial2DView(name="Tree", origin=TREE, visual_bounds=bounds),
                column_shares=[3, 3, 5],
            ),
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
    )
