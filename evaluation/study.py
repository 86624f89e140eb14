"""Runs variants on labeled frames in parallel, and stores each finished frame on disk."""

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.export.frame_files import png
from nurbseg.app.frames import survey
from nurbseg.app.workers import WorkerLostError, in_order, open_workers
from nurbseg.common.computer import computer, versions
from nurbseg.common.errors import FrameFormatError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.answers import Answers
from nurbseg.evaluation.results import StudyResults, StudyStore
from nurbseg.evaluation.scoring.frame import score_frame, score_objects
from nurbseg.evaluation.truth import Truth, ground_truth
from nurbseg.evaluation.variants import LABELS_PREFIX, Variant
from nurbseg.segmentation.points.registration import register
from nurbseg.segmentation.segments import SegmentationTree

#: Categories of the (modified) Object Segmentation Database, as its README lists them, and the last number of
#: each in its two sets.
_OSD = ("boxes", "stacked boxes", "occluded objects", "cylindric objects", "mixed objects", "complex scene")
_OSD_LAST = {"learn": (16, 24, 32, 44), "test": (15, 23, 30, 42, 54, 65)}


@dataclass(frozen=True, slots=True)
class FrameRef:
    """A frame of a source by its position, so that any worker can read it."""

    uri: str
    index: int
    key: str


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The variants to compare, and the frames: of each source at most `frames`, from `start` on.

    `seed` is used by methods with random numbers other than the tree methods, which have a setting for it;
    `pieces` is that of `nurbseg.evaluation.scoring.frame.score_objects`, `truth` that of
    `nurbseg.evaluation.truth.ground_truth`.
    """

    sources: tuple[str, ...]
    variants: tuple[Variant, ...]
    options: SourceOptions = field(default_factory=SourceOptions)
    seed: int = 0
    frames: int | None = None
    start: int = 0
    pieces: int = 1
    truth: Truth = "labels"

    def description(self) -> dict[str, Any]:
        """Return what stored results depend on apart from the variant, which has its own key."""
        options: dict[str, Any] = {
            "intrinsics": self.options.intrinsics,
            "depth_scale": self.options.depth_scale,
            "association_limit_s": self.options.association_limit_s,
        }
        if isinstance(self.options.calibration, Path):
            content = hashlib.sha256(self.options.calibration.read_bytes()).hexdigest()
            options["calibration"] = f"{self.options.calibration} ({content[:8]})"
        return {
            "sources": list(self.sources),
            "options": options,
            "seed": self.seed,
            "pieces": self.pieces,
            "truth": self.truth,
            # Results of different versions are not mixed.
            "nurbseg": versions().get("nurbseg", "not installed"),
        }


def frame_refs(study: Study) -> list[FrameRef]:
    """List the frames of a study without decoding them; raises ValueError if there are none."""
    refs = []
    for place, uri in enumerate(study.sources):
        found, _ = survey(uri, study.options, study.start, study.frames)
        refs += [FrameRef(uri, i, f"{place:02d}-{i:06d}") for i in found]
    if not refs:
        raise ValueError(f"{', '.join(study.sources)}: no frames after --start {study.start}")
    return refs


def run_study(
    study: Study,
    store: StudyStore,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResults:
    """Compute the results of a study that are not yet on disk, and return them all.

    The processes of `open_workers` segment frames; only this process writes results, which do not depend on
    the number of processes. `report` is called after each frame with the numbers of finished frames and of
    all. Raises DriverError if a source cannot be opened, ValueError if the scheduler does not answer or has
    no worker, and WorkerLostError if two processes died while working on a frame.
    """
    todo = []
    refs = frame_refs(study)
    for ref in refs:
        known = store.frame(ref.key)
        missing = tuple(variant for variant in study.variants if variant.key not in known.get("results", {}))
        if missing and not known.get("skipped"):
            todo.append((ref, missing))
    done = len(refs) - len(todo)
    report(done, len(refs))
    with open_workers(jobs, scheduler) as workers:
        for (ref, _), future in in_order(workers, partial(evaluate_frame, study=study), todo):
            try:
                record, files = future.result()
            except WorkerLostError as err:
                raise WorkerLostError(f"{ref.uri}, frame {ref.index}: {err}") from err
            results = {**store.frame(ref.key).get("results", {}), **record.get("results", {})}
            store.keep(ref.key, {**record, "results": results}, files)
            done += 1
            report(done, len(refs))
    frames = [store.frame(ref.key) for ref in refs]
    finished = tuple(frame for frame in frames if not frame.get("skipped"))
    return StudyResults(study.variants, finished, tuple(frame for frame in frames if frame.get("skipped")))


#: Frames that are read again to say why their ground truth cannot be used.
_LOOKED_AT = 20


def why_unlabelled(ref: FrameRef, options: SourceOptions) -> str:
    """Say of a frame that has no labels that it has none, or which cannot be used, and why."""
    with suppress(FrameFormatError), open_source(ref.uri, options) as source:
        source.skip(ref.index)
        source.read(timeout_s=60.0)
        if source.labels_fault:
            return f"no ground truth that can be used: {source.labels_fault}"
    return "no ground truth"


def first_unusable(study: Study) -> str:
    """Say which ground truth of a study's first frames cannot be used, and why; empty without any."""
    for ref in frame_refs(study)[:_LOOKED_AT]:
        why = why_unlabelled(ref, study.options)
        if why != "no ground truth":
            return f" ({why.partition(': ')[2]})"
    return ""


def read_frame(ref: FrameRef, options: SourceOptions) -> RGBDFrame:
    """Read a frame of a source; raises FrameFormatError if it is damaged."""
    with open_source(ref.uri, options) as source:
        source.skip(ref.index)
        return source.read(timeout_s=60.0)


def readable_frames(
    study: Study, report: Callable[[FrameFormatError], object] = lambda err: None
) -> Iterator[tuple[FrameRef, RGBDFrame]]:
    """Yield the frames of a study, except damaged ones, whose errors are passed to `report`."""
    for ref in frame_refs(study):
        try:
            yield ref, read_frame(ref, study.options)
        except FrameFormatError as err:
            report(err)


def evaluate_frame(
    task: tuple[FrameRef, Sequence[Variant]], study: Study
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Segment one frame with several variants and score each; return scores, and files by path in the store.

    Work that variants share (reading, registration, and cuts and fits of one method) is done once. A frame
    that is damaged or has no pixel with both depth and ground truth is recorded as skipped.
    """
    ref, variants = task
    cv2.setNumThreads(1)
    try:
        frame = read_frame(ref, study.options)
    except FrameFormatError as err:
        return {"key": ref.key, "skipped": str(err)}, {}
    cloud = register(frame)
    about = {
        **asdict(ref),
        "name": frame.name or str(frame.index),
        "category": category_of(frame.name, ref.uri),
        "truth": study.truth,
        "computer": computer(),
    }
    if frame.labels is None:
        return {**about, "skipped": why_unlabelled(ref, study.options)}, {}
    if not (cloud.valid & (frame.labels > 0)).any():
        return {**about, "skipped": "no pixel has both depth and ground truth"}, {}
    truth = ground_truth(frame.labels, study.truth, study.pieces)
    results: dict[str, Any] = {}
    files: dict[str, bytes] = {}
    answers = Answers(cloud, frame.name, ref.index, study.seed)
    for variant in variants:
        labels, tree = answers.of(variant)
        try:
            scores = {
                **score_frame(labels, truth, cloud.valid)._asdict(),
                **score_objects(labels, truth, cloud.points_m, study.pieces)._asdict(),
            }
        except ValueError as err:
            raise ValueError(f"{ref.uri}: frame {about['name']}: {variant.name}: {err}") from err
        # JSON has no NaN.
        results[variant.key] = {name: None if np.isnan(value) else value for name, value in scores.items()}
        files[label_path(ref.key, variant)] = label_png(labels)
        if tree is not None:
            files[tree_path(ref.key, variant)] = outline(tree, variant)
    return {**about, "results": results}, files


def times_per_frame(study: Study, frames: int) -> Mapping[str, float]:
    """Return each variant's median time per frame in seconds, without shared work and registration.

    The first frames that are not damaged are used; each variant runs once before it is timed. Label images of
    other programs have no time.
    """
    first = islice(readable_frames(study), frames)
    clouds = [(register(frame), frame.name, ref.index) for ref, frame in first]
    seconds = {}
    for variant in study.variants:
        if variant.method.startswith(LABELS_PREFIX):
            continue
        taken = []
        for cloud, name, index in (*clouds[:1], *clouds):
            start = time.perf_counter()
            Answers(cloud, name, index, study.seed).of(variant)
            taken.append(time.perf_counter() - start)
        seconds[variant.name] = float(np.median(taken[1:]))
    return seconds


def label_path(key: str, variant: Variant) -> str:
    """Return the path of a variant's labels of a frame in the store."""
    return f"labels/{variant.key}/{key}.png"


def tree_path(key: str, variant: Variant) -> str:
    """Return the path of a variant's tree of a frame in the store."""
    return f"trees/{variant.key}/{key}.json"


def label_png(labels: NDArray[np.integer]) -> bytes:
    """Encode labels as a PNG of 16 bits; labels that need more are renumbered."""
    if labels.max(initial=0) > np.iinfo(np.uint16).max or labels.min(initial=0) < 0:
        labels = np.unique(labels, return_inverse=True)[1].reshape(labels.shape)
    return png(labels.astype(np.uint16))


def outline(tree: SegmentationTree, variant: Variant) -> bytes:
    """Encode the parts of a tree that are drawn as JSON."""
    segments = [
        {
            "name": segment.name,
            "size": int(segment.pixels.size),
            "value": segment.fit.values.get(variant.config.metric),
            "ratio": segment.ratio,
            "stop": None if segment.stop is None else segment.stop.value,
        }
        for segment in tree.segments
    ]
    return json.dumps({"segments": segments}).encode()


def category_of(name: str, uri: str) -> str:
    """Return a frame's category.

    Frames of the Object Segmentation Database (``learn12``, ``test3``) have those of the data set; frames
    named ``scene2...`` have one for each scene, as in the paper's tables; others have one for each source.
    """
    if match := re.fullmatch(r"(learn|test)(\d+)", name):
        for last, category in zip(_OSD_LAST[match[1]], _OSD, strict=False):
            if int(match[2]) <= last:
                return category
    if match := re.match(r"scene[_ ]?(\d+)", name):
        return f"scene {int(match[1])}"
    return PurePath(uri.partition("?")[0]).stem or uri
