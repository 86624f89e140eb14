"""Checks an export by segmenting its frames again, as the same program did on the same computer."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.app.export.objects import objects_document
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.export.tree import tree_document
from nurbseg.common.computer import made_by
from nurbseg.common.files import read_json
from nurbseg.common.frame import RGBDFrame
from nurbseg.evaluation.check.exported import ExportedFrame
from nurbseg.evaluation.check.surfaces import SURFACES
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import Level
from nurbseg.segmentation.vocabulary import display_name

#: Differences of a frame's file that are listed.
_LISTED = 5
_PARTS = ("degree", "window", "knots_u", "knots_v", "control_points_m", "weights")


class Repetition:
    """Segments the frames of an export again, and compares all that was written.

    This finds what nothing else in the export determines: the parts of a rejected trial, the evidence of a
    live tree, and settings that act on cuts and fits alone. Frames that continue each other are repeated from
    the first one on, until one is missing. `frames` counts the repeated ones.
    """

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.frames = 0
        self._folder = folder
        self._settings = settings
        #: Index of the frame that the next one has to continue; None before the first.
        self._previous: int | None = None
        self._segmenter: Segmenter | None = None
        # What a clock decided cannot be repeated, and other processors round products differently.
        by_time = settings.target_fps > 0 or settings.config.budget_ms > 0
        if settings.computer == made_by() and not by_time:
            self._segmenter = Segmenter(
                settings.config,
                temporal=settings.temporal,
                trials_max=settings.trials_max,
                every_surface=settings.surfaces,
            )

    def check(self, frame: ExportedFrame, recorded: RGBDFrame, *, follows: bool) -> None:
        """Segment a frame again, and compare it unless something was found in it before.

        Parameters
        ----------
        frame : ExportedFrame
            As it was exported.
        recorded : RGBDFrame
            The same frame, with its depth prepared.
        follows : bool
            Whether no frame of the recording lies between this one and the one before.
        """
        if self._segmenter is None:
            return
        if self._settings.temporal and not (follows if self.frames else _from_scratch(frame)):
            self._segmenter = None
            return
        result = self._segmenter.process(recorded)
        self.frames += 1
        if not frame.findings:
            self._compare(frame, result)

    def _compare(self, frame: ExportedFrame, result: FrameResult) -> None:
        documents = {"tree.json": tree_document(result, self._settings.config.metric)}
        if frame.objects_file is not None:
            documents["objects.json"] = objects_document(result)
        for file, document in documents.items():
            expected = dict(_leaves(json.loads(json.dumps(document))))
            found = dict(_leaves(read_json(self._folder / f"{frame.stem}_{file}")))
            unlike = [key for key in expected | found if expected.get(key) != found.get(key)]
            for key in unlike[:_LISTED]:
                segment, field = key[1:3] if key[0] == "segments" and len(key) > 2 else ("", key[0])
                field = " ".join((field, *key[3 if segment else 1 :]))
                wanted = f"{expected.get(key)} when segmented again"
                frame.wrong(segment, field, wanted, found.get(key), file)
        levels: dict[str, Level | None] = {"labels": None, "surfaces": "surfaces", "objects": "objects"}
        for kind, image in frame.images.items():
            again = result.labels(levels[kind])
            if not np.array_equal(image, again):
                pixels = np.count_nonzero(image != again)
                frame.wrong("", "labels", "those when segmented again", f"{pixels} others", f"{kind}.png")
        self._compare_surfaces(frame, result)

    def _compare_surfaces(self, frame: ExportedFrame, result: FrameResult) -> None:
        for segment in result.tree.segments:
            name, surface = display_name(segment.name), segment.fit.surface
            exported = frame.surfaces.get(name)
            if surface is None or exported is None:
                continue
            for part in _PARTS:
                if not np.array_equal(getattr(surface, part), getattr(exported, part)):
                    frame.wrong(name, part, "that of the fit when segmented again", "another", SURFACES)
                    return


def _from_scratch(frame: ExportedFrame) -> bool:
    """Whether a frame of a live tree continues none: all in it is new, and labels begin at 1."""
    now = frame.tree.frame
    labels = sorted(leaf.leaf for leaf in frame.leaves if leaf.leaf)
    own = all(segment.measured == now == segment.judged for segment in frame.segments.values())
    return own and labels == list(range(1, len(labels) + 1))


def _leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the path of each number and text in a JSON document, segments by their names."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _leaves(each, (*path, key))
    elif isinstance(value, list):
        for place, each in enumerate(value):
            named = isinstance(each, dict) and path == ("segments",)
            yield from _leaves(each, (*path, str(each.get("name")) if named else str(place)))
        yield (*path, "length"), len(value)
    else:
        yield path, value
