"""Why a frame was segmented as it was, step by step, as values, pictures and one HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.files import replacing
from nurbseg.library.explanation.page import page
from nurbseg.library.explanation.panels import Panels, panels
from nurbseg.library.explanation.steps import Step, steps_of
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.judged import JudgedSplit
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.grid import grid_step
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Explanation:
    """The recursion of one frame.

    Parameters
    ----------
    title : str
        The frame, the method and its settings.
    cloud, tree : PointMap, SegmentationTree
        The frame's points and segments.
    steps : tuple of Step
        Every split that decided, kept or rejected, and every object of several surfaces.
    grid_step : int
        Distance of the rows and columns of the grid on which splits are decided, pixels.
    picture : (H, W, 3) uint8
        RGB, with the objects of the result outlined and numbered.
    step_of_object : mapping of int to int
        By the label of an object, the step that made it: its merging, or the split with its surface.
    """

    title: str
    cloud: PointMap
    tree: SegmentationTree
    steps: tuple[Step, ...]
    grid_step: int
    picture: NDArray[np.uint8]
    step_of_object: Mapping[int, int]

    def panels(self, step: Step) -> Panels:
        """Return the pictures of a step as arrays."""
        return panels(step, self.cloud.color, self.grid_step)

    def html(self) -> str:
        """Return a page of all steps, which needs no other file or host; arrow keys go through them."""
        steps = [(step, self.panels(step)) for step in self.steps]
        return page(self.title, self.tree, steps, self.picture, self.step_of_object)

    def save(self, path: str | Path) -> None:
        """Write the page; an existing file is replaced. Only its user may read it.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        # Images are private.
        with replacing(Path(path), mode=0o600) as file:
            file.write(self.html().encode())

    def _repr_html_(self) -> str:
        """Return the page within a frame, so that a notebook shows it without applying its own style."""
        return (
            f'<iframe srcdoc="{escape(self.html())}" style="width:100%;aspect-ratio:3/2;border:0"></iframe>'
        )


def explained(
    cloud: PointMap,
    config: SegmentationConfig,
    name: str,
    labels: NDArray[np.uint16],
    picture: NDArray[np.uint8],
) -> Explanation:
    """Segment a frame by itself, without a time limit, and explain each decision.

    Objects are called by the labels of a result, (H, W), whose tree may differ if its frame continues others.
    """
    judged: list[JudgedSplit] = []
    config = replace(config, budget_ms=0)
    tree = segment(cloud, config, observe=judged.append)
    object_of_label = _matches(labels.ravel(), tree.labels("objects").ravel())
    steps = steps_of(tree, judged, config, {number: label for label, number in object_of_label.items()})
    groups = [each.leaves for each in tree.objects] or [(leaf.name,) for leaf in tree.leaves()]
    step_of = {part.name: step.number for step in steps for part in step.parts if part.name is not None}
    title = f"{name}, method {config.method}, metric {config.metric.upper()}, T = {config.ratio_max:g}"
    firsts = {label: groups[number - 1][0] for label, number in object_of_label.items()}
    made = {label: step_of[first] for label, first in firsts.items() if first in step_of}
    return Explanation(title, cloud, tree, steps, grid_step(cloud.valid, config.decimation), picture, made)


def _matches(labels: NDArray[np.uint16], own: NDArray[np.uint16]) -> dict[int, int]:
    """Return, for each label of an object, the object of a tree that shares most pixels."""
    shared = np.zeros((int(labels.max(initial=0)) + 1, int(own.max(initial=0)) + 1), dtype=np.intp)
    np.add.at(shared, (labels, own), 1)
    shared[:, 0] = 0
    return {int(label): int(shared[label].argmax()) for label in np.unique(labels[(labels > 0) & (own > 0)])}
