"""The files of an export as they are read back, and findings on them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.export.run_settings import RunSettings
from nurbseg.segmentation.points.grid import grid_step
from nurbseg.segmentation.vocabulary import SPLITS

#: Maximum step of a grid that a rate controller made coarser.
_STEP_MOST = 8


@dataclass(frozen=True, slots=True)
class Finding:
    """A contradiction in a field of a segment (or "" for the frame) in one of its files."""

    file: str
    segment: str
    field: str
    expected: str
    found: str

    def __str__(self) -> str:
        where = " ".join(each for each in (self.segment, self.field) if each)
        parts = (self.file, where, f"expected {self.expected}, found {self.found}")
        # Names of files and segments may hold anything.
        text = ": ".join(part for part in parts if part)
        return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


class Measured(NamedTuple):
    """A value of the deciding metric, None if there is none, and its number of points."""

    value: float | None
    points: int


class ExportedTrial(NamedTuple):
    """A split that was tried: value and points of the whole and of each part."""

    metric: str
    value: float | None
    points: int
    parts: tuple[Measured, ...]
    kept: bool

    @property
    def whole(self) -> Measured:
        """Value and points of the whole."""
        return Measured(self.value, self.points)


class ExportedSegment(NamedTuple):
    """A segment in the tree's file; `measured` and `judged` are the file's own frame if missing there."""

    name: str
    parent: str | None
    children: tuple[str, ...]
    size: int
    depth: int
    value: float | None
    values: Mapping[str, float | None]
    ratio: float | None
    trial: ExportedTrial | None
    division: str | None
    stop: str | None
    points: int
    surface: bool
    reason: str
    label: int | None
    leaf: int | None
    object: int | None
    floor: float
    measured: int
    judged: int

    @property
    def counted(self) -> float:
        """The value as it counts in a ratio: at least its floor, and 0 if it is missing."""
        return max(self.value or 0.0, self.floor)


class ExportedObject(NamedTuple):
    """An object's label and the names of its leaves."""

    object: int
    leaves: tuple[str, ...]


class MeasuredBox(NamedTuple):
    """The box around an object's points: center, lengths of the edges, and unit vectors along them."""

    center_m: tuple[float, ...]
    size_m: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]


class MeasuredSupport(NamedTuple):
    """The plane that the objects stand on."""

    normal: tuple[float, ...]
    camera_height_m: float
    found_by: str


class MeasuredSigma(NamedTuple):
    """Standard deviations of the errors of a measured object's box."""

    center_m: float
    size_m: float
    yaw_rad: float


class MeasuredObject(NamedTuple):
    """An object in the file of the measured objects."""

    object: int
    pixels: int
    centroid_m: tuple[float, ...]
    box: MeasuredBox
    visible: MeasuredBox
    sigma: MeasuredSigma
    support_from_object: tuple[tuple[float, ...], ...] | None
    normal: tuple[float, ...] | None
    color: tuple[float, ...]
    rms_m: float | None
    leaves: tuple[str, ...]
    pending: bool


class MeasuredCamera(NamedTuple):
    """The depth camera in the file of the measured objects."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]


class ExportedObjects(NamedTuple):
    """The file of a frame's measured objects."""

    frame: int
    name: str
    timestamp_ns: int
    coordinates: str
    camera: MeasuredCamera
    level: str
    support: MeasuredSupport | None
    objects: tuple[MeasuredObject, ...]


class ExportedContact(NamedTuple):
    """Two leaves in contact, whether they were merged, and the evidence."""

    first: str
    second: str
    merged: bool
    samples: int
    log_odds: float
    evidence: Mapping[str, float]


class ExportedMerge(NamedTuple):
    """Two groups of leaves that meet, by their first leaves, whether they were merged, and the evidence."""

    first: str
    second: str
    merged: bool
    log_odds: float
    evidence: Mapping[str, float]


class ExportedTree(NamedTuple):
    """The file of a frame's tree."""

    frame: int
    name: str
    timestamp_ns: int
    height: int
    width: int
    metric: str
    level: str
    segments: tuple[ExportedSegment, ...]
    objects: tuple[ExportedObject, ...]
    contacts: tuple[ExportedContact, ...]
    merges: tuple[ExportedMerge, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ExportedSurface:
    """A surface in the file of surfaces, with the shapes and units of `NurbsSurface`."""

    degree: tuple[int, int]
    window: tuple[int, int, int, int]
    knots_u: NDArray[np.float64]
    knots_v: NDArray[np.float64]
    control_points_m: NDArray[np.float64]
    weights: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ExportedFrame:
    """All files of a frame, whose names begin with `stem`, and what was found wrong in them so far.

    Images are "labels" and, if there are objects, "surfaces" and "objects", (H, W) uint16. Surfaces and
    measured pixels, (N,) int64 flat indices, are by segment name; empty if surfaces are not exported.
    """

    stem: str
    settings: RunSettings
    tree: ExportedTree
    images: Mapping[str, NDArray[np.uint16]]
    surfaces: Mapping[str, ExportedSurface]
    measured: Mapping[str, NDArray[np.int64]]
    #: Measured objects, if they are exported.
    objects_file: ExportedObjects | None = None
    findings: list[Finding] = field(default_factory=list)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.tree.height, self.tree.width

    def wrong(
        self, segment: str, field: str, expected: object, found: object, file: str = "tree.json"
    ) -> None:
        """Add a finding in the file of the tree, or in that with another ending."""
        self.findings.append(Finding(f"{self.stem}_{file}", segment, field, str(expected), str(found)))

    def compare(self, segment: str, field: str, expected: object, found: object, why: str = "") -> None:
        """Add a finding, with the reason `why`, if the tree holds something else than expected."""
        if found != expected:
            self.wrong(segment, field, f"{expected}{why}", found)

    @cached_property
    def segments(self) -> Mapping[str, ExportedSegment]:
        """Segments by name, in the order of the file."""
        return {segment.name: segment for segment in self.tree.segments}

    @cached_property
    def leaves(self) -> tuple[ExportedSegment, ...]:
        """Segments without children, in the order of the file."""
        return tuple(segment for segment in self.segments.values() if not segment.children)

    @cached_property
    def objects(self) -> Mapping[int, tuple[str, ...]]:
        """Names of the leaves of each object; empty if nothing was merged."""
        return {each.object: each.leaves for each in self.tree.objects}

    @cached_property
    def object_of(self) -> Mapping[str, int]:
        """Label of each leaf's object."""
        return {name: number for number, names in self.objects.items() for name in names}

    @cached_property
    def step(self) -> int:
        """Step of the grid on which splits were decided and leaves measured, pixels."""
        valid = self.images["labels"] > 0
        asked = grid_step(valid, self.settings.config.decimation)
        if self.settings.target_fps > 0:
            for step in range(asked, _STEP_MOST + 1):
                if np.count_nonzero(valid[::step, ::step]) == self.points_below("P"):
                    return step
        return asked

    @property
    def points_min(self) -> float:
        """T_p in points of the grid."""
        config = self.settings.config
        paper, extended = config.stag15.segment_pixels_min, config.extended.piece_pixels_min
        pixels_min = paper if config.method == "stag15" else extended
        return pixels_min * self.shape[0] * self.shape[1] / (640 * 480) / self.step**2

    @property
    def leaf_image(self) -> NDArray[np.uint16]:
        """Label of each pixel's leaf, (H, W)."""
        return self.images["surfaces" if self.objects else "labels"]

    def below(self, name: str) -> list[ExportedSegment]:
        """Return the leaves below a segment, or a leaf itself."""
        return [leaf for leaf in self.leaves if leaf.name.startswith(name)]

    def points_below(self, name: str) -> int:
        """Return the number of points of all leaves below a segment."""
        return sum(leaf.points for leaf in self.below(name))

    def cuts_above(self, name: str) -> int:
        """Return the number of cuts and creases between the root and a segment."""
        above = (self.segments[name[:end]].division for end in range(1, len(name)))
        return sum(division in SPLITS for division in above)

    def parts(self, name: str) -> list[ExportedSegment]:
        """Return the parts of a split, which may be below segments divided by a gap."""
        found, waiting = [], [self.segments[child] for child in self.segments[name].children]
        while waiting:
            part = waiting.pop(0)
            if part.division == "gap":
                waiting[:0] = [self.segments[child] for child in part.children]
            else:
                found.append(part)
        return found
