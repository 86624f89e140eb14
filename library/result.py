"""The result of a frame: points, segments and times.

What measures, draws and writes objects is imported when it is asked for: a run may need none of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import RGBDFrame
from nurbseg.segmentation.config import Level, SegmentationConfig
from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.live.identity import NEW_SEQUENCE, Event, Identities
from nurbseg.segmentation.live.tree import UpdateReport
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree, known_level

if TYPE_CHECKING:
    from nurbseg.library.explanation.explanation import Explanation
    from nurbseg.library.objects import LostObject, MeasuredObject
    from nurbseg.library.tracking import ObjectTracker


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FrameResult:
    """A frame and its segmentation.

    Parameters
    ----------
    frame : RGBDFrame
        As it was captured.
    cloud : PointMap
        Its colored points.
    tree : SegmentationTree
        Its segments.
    elapsed_ms : mapping of str to float
        Time of each stage, milliseconds.
    surface_identities, object_identities : Identities or None
        Identities of the tree's leaves and objects, if frames continue each other. Then labels are
        identities, and persist from frame to frame.
    update : UpdateReport or None
        Update of the live tree; None if the frame was segmented independently.
    tracker : callable or None
        Returns the tracker of the objects of successive frames; None measures those of each frame by itself.
    config : SegmentationConfig
        Settings of the segmentation.
    """

    frame: RGBDFrame
    cloud: PointMap
    tree: SegmentationTree
    elapsed_ms: Mapping[str, float]
    surface_identities: Identities | None = None
    object_identities: Identities | None = None
    update: UpdateReport | None = None
    tracker: Callable[[], ObjectTracker] | None = None
    config: SegmentationConfig = field(default_factory=SegmentationConfig)
    _measured: list[tuple[MeasuredObject, ...]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "elapsed_ms", MappingProxyType(dict(self.elapsed_ms)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a result with its objects, which may follow from those of frames before."""
        fields = (self.frame, self.cloud, self.tree, dict(self.elapsed_ms))
        identities = (self.surface_identities, self.object_identities)
        return _restored, (*fields, *identities, self.update, self.config, self.objects, self.lost_objects)

    def __repr__(self) -> str:
        return f"FrameResult(frame {self.frame.index}, {self.tree})"

    @property
    def surface_of_leaf(self) -> NDArray[np.uint16]:
        """Label of each leaf's surface, by the leaf's position from 1 on; 0 at position 0."""
        return np.array([0, *self.surface_labels], dtype=np.uint16)

    @property
    def object_of_leaf(self) -> NDArray[np.uint16]:
        """Label of each leaf's object, or surface if there are none, by the leaf's position from 1 on."""
        if not self.tree.objects:
            return self.surface_of_leaf
        numbered = zip(self.object_labels, self.tree.objects, strict=True)
        label = {name: label for label, each in numbered for name in each.leaves}
        return np.array([0, *map(label.__getitem__, self.tree.leaf_names)], dtype=np.uint16)

    def labels(self, level: Level | None = None) -> NDArray[np.uint16]:
        """Return the label of every pixel, (H, W) uint16; 0 without depth.

        Parameters
        ----------
        level : {"surfaces", "objects"}, optional
            What a label stands for, by default the tree's level.

        Raises
        ------
        ValueError
            If there is no such level.
        """
        objects = known_level(self.tree.level if level is None else level) != "surfaces"
        of_leaf = self.object_of_leaf if objects else self.surface_of_leaf
        return apply_lookup_table(of_leaf, self.tree.labels("surfaces"))

    @property
    def objects(self) -> tuple[MeasuredObject, ...]:
        """Measurements of each object, in the order of labels; made at the first access.

        Where frames continue each other, those of one frame follow from those of the frames before whose
        objects were asked for.
        """
        if not self._measured:
            tracker = self.tracker or partial(new_tracker, self.config)
            self._measured.append(tracker().measure(self))
        return self._measured[0]

    def picture(self) -> NDArray[np.uint8]:
        """Return the frame with its objects outlined and numbered, (H, W, 3) uint8 RGB."""
        from nurbseg.library.picture import outlined

        return outlined(self.cloud.color, self.labels("objects"), self.objects)

    def show(self) -> None:
        """Show the picture in a notebook, also within a loop; raises RuntimeError where there is none."""
        try:
            from IPython.display import display  # type: ignore[import-not-found]
        except ImportError as err:
            raise RuntimeError("show() is for notebooks; picture() returns the image as an array") from err
        display(self)

    def explain(self) -> Explanation:
        """Segment the frame by itself once more, and return why it was segmented so, step by step.

        A notebook shows it; its `save` writes it as one HTML page. In a live run the tree may differ, since
        there a frame continues others.
        """
        from nurbseg.library.explanation.explanation import explained

        name = self.frame.name or f"frame {self.frame.index}"
        name += "" if self.update is None else " by itself"
        return explained(self.cloud, self.config, name, self.labels("objects"), self.picture())

    def _repr_png_(self) -> bytes:
        """Return the picture as PNG: notebooks show it."""
        _, png = cv2.imencode(".png", cv2.cvtColor(self.picture(), cv2.COLOR_RGB2BGR))
        return png.tobytes()

    def object(self, label: int) -> MeasuredObject:
        """Return the object that has a label.

        Raises
        ------
        ValueError
            If there is none.
        """
        for each in self.objects:
            if each.label == label:
                return each
        present = ", ".join(str(each.label) for each in self.objects) or "none"
        raise ValueError(f"label: expected that of an object in this frame ({present}), got {label!r}")

    def export(self, path: str | Path) -> None:
        """Write the surfaces as a 3-D model, an object each; an existing file is replaced.

        Meters in the depth camera's frame: x right, y down, z forward.

        Parameters
        ----------
        path : str or Path
            The name ends in .glb (triangles with the photo as their texture; y is up), .ply (colored
            triangles) or .step (NURBS trimmed to their pixels, for CAD programs).

        Raises
        ------
        ValueError
            If the name has another ending.
        BackendMissingError
            If a library for .step is missing; the message says how to install it.
        """
        from nurbseg.library.models.model import export

        export(self.objects, path)

    @property
    def lost_objects(self) -> tuple[LostObject, ...]:
        """Objects that were measured within the last two seconds, but are not in this frame."""
        return () if self.tracker is None else self.tracker().lost(self)

    @property
    def surface_labels(self) -> tuple[int, ...]:
        """Label of each leaf of the tree."""
        return _each_identified(len(self.tree.leaf_names), self.surface_identities)

    @property
    def object_labels(self) -> tuple[int, ...]:
        """Label of each object of the tree."""
        return _each_identified(len(self.tree.objects), self.object_identities)

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened to segments of the tree's level since the previous frame."""
        by_object = self.tree.objects and self.tree.level != "surfaces"
        identities = self.object_identities if by_object else self.surface_identities
        is_new = self.update is not None and self.update.reset == NEW_SEQUENCE
        begun = (Event("restart", 0),) if is_new else ()
        return begun if identities is None else (*begun, *identities.events)


@dataclass(frozen=True, slots=True)
class _Measured:
    """The objects of a result that was pickled, in place of the tracker that measured them."""

    objects: tuple[MeasuredObject, ...]
    lost_objects: tuple[LostObject, ...]

    def __call__(self) -> _Measured:
        return self

    def measure(self, result: FrameResult) -> tuple[MeasuredObject, ...]:
        return self.objects

    def lost(self, result: FrameResult) -> tuple[LostObject, ...]:
        return self.lost_objects


def _restored(*fields: Any) -> FrameResult:
    """Return a result from what `FrameResult.__reduce__` has taken of it."""
    frame, cloud, tree, elapsed_ms, surfaces, objects, update, config, measured, lost = fields
    tracker: Any = _Measured(measured, lost)
    return FrameResult(frame, cloud, tree, elapsed_ms, surfaces, objects, update, tracker, config)


def new_tracker(config: SegmentationConfig) -> ObjectTracker:
    """Return a tracker of objects; what it needs is loaded at the first call."""
    from nurbseg.library.tracking import ObjectTracker

    return ObjectTracker(config.extended.inverse_depth_noise, config.extended.up)


def _each_identified(count: int, identities: Identities | None) -> tuple[int, ...]:
    if identities is None:
        return tuple(range(1, count + 1))
    # A leaf without pixels has no identity, and its label is 0.
    return tuple(identities.of_label.get(label, 0) for label in range(1, count + 1))
