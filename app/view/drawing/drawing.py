"""Turns a frame's result into what views show."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.frame import Moment, ShownObjects, TreeNode, ViewFrame
from nurbseg.library.contact_words import evidence
from nurbseg.library.meshing import surface_mesh
from nurbseg.library.result import FrameResult
from nurbseg.library.surface_mesh import SurfaceMesh
from nurbseg.segmentation.config import REFERENCE_PIXELS, Metric
from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.live.identity import event_text
from nurbseg.segmentation.points.registration import PointMap


def drawn(
    result: FrameResult,
    view: ViewConfig,
    metric: Metric,
    *,
    rate_hz: float = 0.0,
    in_full: bool = True,
) -> ViewFrame:
    """Return what views show of a frame, in the detail that `view` asks for.

    Boxes, the table of objects and the mesh of surfaces are left out unless `in_full`.
    """
    frame, tree = result.frame, result.tree
    # Meshes need the tree's own labels; the ones shown persist from frame to frame.
    labels = tree.labels("surfaces")
    surfaces = apply_lookup_table(result.surface_of_leaf, labels)
    objects = apply_lookup_table(result.object_of_leaf, labels) if tree.objects else None
    things = surfaces if objects is None else objects
    points_m, point_labels, point_colors = _some_points(result.cloud, things, view.points_max)
    registered = frame.calibration.is_registered
    return ViewFrame(
        moment=Moment(frame.index, frame.timestamp_ns),
        name=frame.name,
        metric=metric,
        calibration=frame.calibration,
        color=frame.color if registered else result.cloud.color,
        unregistered_color=None if registered else frame.color,
        depth_mm=frame.depth_mm,
        surfaces=surfaces,
        objects=objects,
        truth=frame.labels,
        truth_match=None if frame.labels is None else _best_overlaps(frame.labels, things),
        points_m=points_m,
        point_labels=point_labels,
        point_colors=point_colors,
        measured=_measured(result) if in_full else None,
        mesh=_mesh(result, labels, view) if in_full else None,
        tree=_nodes(result, metric),
        merges=tuple(_merges(result)) if in_full else None,
        elapsed_ms=dict(result.elapsed_ms),
        rate_hz=rate_hz,
        events=tuple(map(event_text, result.events)),
        grid_step=None if result.update is None else result.update.step,
        reset_reason="" if result.update is None else result.update.reset,
    )


def _mesh(result: FrameResult, labels: NDArray[np.uint16], view: ViewConfig) -> SurfaceMesh:
    mesh = surface_mesh(result.tree, labels, view.mesh_step_px * np.sqrt(labels.size / REFERENCE_PIXELS))
    return replace(mesh, labels=result.surface_of_leaf[mesh.labels])


def _merges(result: FrameResult) -> Iterator[str]:
    """Describe, for each object of several surfaces, which of them touch and why they were merged."""
    tree = result.tree
    label_of = {leaf.name: label for label, leaf in zip(result.surface_labels, tree.leaves(), strict=True)}
    object_of = {name: place for place, each in enumerate(tree.objects) for name in each.leaves}
    pairs: dict[int, list[str]] = {}
    for contact in tree.contacts:
        place = object_of.get(contact.first)
        if place is not None and place == object_of.get(contact.second):
            text = f"{label_of[contact.first]} with {label_of[contact.second]}: {evidence(contact)}"
            pairs.setdefault(place, []).append(text)
    for place in sorted(pairs):
        yield f"**{result.object_labels[place]}**: {'; '.join(pairs[place])}"


def _nodes(result: FrameResult, metric: Metric) -> tuple[TreeNode, ...]:
    label = iter(result.surface_labels)
    thing = iter(result.object_of_leaf[1:].tolist())
    return tuple(
        TreeNode(
            name=segment.name,
            children=segment.children,
            label=next(label) if segment.is_leaf else None,
            thing=(next(thing) or None) if segment.is_leaf and result.tree.objects else None,
            pixels=segment.pixels.size,
            value=segment.fit.values.get(metric),
            ratio=segment.ratio,
            stop=segment.stop,
            division=segment.division,
            has_surface=segment.fit.surface is not None,
            measured=segment.measured,
            judged=segment.judged,
        )
        for segment in result.tree.segments
    )


def _best_overlaps(truth: NDArray[np.uint16], labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return each region of the ground truth and the label that overlaps it most, in every fourth pixel."""
    regions, things = truth[::2, ::2].ravel().astype(np.intp), labels[::2, ::2].ravel()
    count = int(things.max(initial=0)) + 1
    overlaps = np.bincount(regions * count + things, minlength=(int(regions.max(initial=0)) + 1) * count)
    overlaps = overlaps.reshape(-1, count)
    present = np.flatnonzero(overlaps.any(axis=1))
    overlaps[:, 0] = 0
    return np.stack([present, overlaps[present].argmax(axis=1)], axis=1).astype(np.uint16)


def _some_points(
    cloud: PointMap, labels: NDArray[np.uint16], points_max: int
) -> tuple[NDArray[np.float32], NDArray[np.uint16], NDArray[np.uint8]]:
    """Return at most `points_max` evenly spaced points that have a label, their labels and colors."""
    # A step beyond the image leaves one point, which is not shown either.
    step = max(1, int(np.ceil(np.sqrt(labels.size / max(points_max, 1)))))
    coarse = labels[::step, ::step]
    shown = (coarse > 0) & (points_max > 0)
    return cloud.points_m[::step, ::step][shown], coarse[shown], cloud.color[::step, ::step][shown]


def _measured(result: FrameResult) -> ShownObjects:
    objects = result.objects
    boxes = [each.box for each in objects]
    return ShownObjects(
        labels=np.array([each.label for each in objects], dtype=np.uint16),
        distance_m=np.array([np.linalg.norm(each.centroid_m) for each in objects]),
        center_m=np.array([box.center_m for box in boxes]).reshape(-1, 3),
        size_m=np.array([box.size_m for box in boxes]).reshape(-1, 3),
        turn=np.array([box.quaternion for box in boxes]).reshape(-1, 4),
        fit_error_m=np.array([each.fit_error_m or np.nan for each in objects]),
        sure=np.array([each.is_sure for each in objects], dtype=np.bool_),
    )
