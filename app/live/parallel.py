"""Segments frames independently in several processes; results come in the order of frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import cv2

from nurbseg.app.errors import FrameFailedError, error_text
from nurbseg.app.export.frame_files import frame_files
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.app.workers import in_order, open_workers
from nurbseg.common.frame import RGBDFrame
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import Registration

if TYPE_CHECKING:
    from nurbseg.app.export.exporter import Exporter
    from nurbseg.app.live.feed import Feed
    from nurbseg.app.live.report import RunReport
    from nurbseg.app.view.view import View


#: What a thread keeps between its frames.
_kept = threading.local()


@dataclass(frozen=True, slots=True, eq=False)
class Segmented:
    """The result of a frame."""

    #: Number of segments.
    leaves: int
    #: Time of each stage, milliseconds.
    elapsed_ms: Mapping[str, float]
    #: Exported files by name.
    files: Mapping[str, bytes]
    #: Left out unless needed: it takes ten times as much memory as the frame.
    result: FrameResult | None = None


def segment_alone(
    frame: RGBDFrame, config: SegmentationConfig, *, export: ExportConfig | None, whole: bool = False
) -> Segmented:
    """Segment a frame independently, and encode the files that `export` asks for."""
    # The other cores work on other frames.
    cv2.setNumThreads(1)
    _kept.registration = getattr(_kept, "registration", None) or Registration()
    result = process_frame(frame, config, _kept.registration)
    started_s = time.perf_counter()
    files = {} if export is None else frame_files(result, config.metric, export)
    elapsed_ms = {**result.elapsed_ms, "encode": 1e3 * (time.perf_counter() - started_s)}
    return Segmented(len(result.tree.leaf_names), elapsed_ms, files, result if whole else None)


def segment_in_parallel(
    captured: Iterable[RGBDFrame],
    config: SegmentationConfig,
    *,
    count: int,
    export: ExportConfig | None,
    whole: bool,
) -> Generator[tuple[RGBDFrame, Segmented]]:
    """Segment frames with `segment_alone` in several processes, and yield them in their order.

    At most two frames per process are taken in advance. `whole` says whether the complete result is needed.
    Raises FrameFailedError if a frame cannot be segmented, or two processes died while working on it.
    """
    segment = partial(segment_alone, config=config, export=export, whole=whole)
    with open_workers(count) as workers:
        for each, future in in_order(workers, segment, captured):
            try:
                segmented = future.result()
            except Exception as err:
                name = f" ({each.name})" if each.name else ""
                raise FrameFailedError(
                    f"frame {each.index}{name} cannot be segmented: {error_text(err)}"
                ) from err
            latency_ms = 1e3 * (each.age_s or 0.0)
            waited_ms = latency_ms - sum(segmented.elapsed_ms.values())
            elapsed_ms = {"wait": waited_ms, **segmented.elapsed_ms, "capture_to_labels": latency_ms}
            yield each, replace(segmented, elapsed_ms=elapsed_ms)


def run_in_parallel(
    config: SegmentationConfig,
    feed: Feed,
    count: int,
    exporter: Exporter | None,
    view: View,
    report: RunReport,
) -> None:
    """Segment frames in several processes and pass the results on until the source ends."""
    frames = (captured for captured in feed.frames() if captured is not None)
    export = None if exporter is None else exporter.export
    results = segment_in_parallel(frames, config, count=count, export=export, whole=view.shows)
    with closing(results):
        for captured, segmented in results:
            elapsed_ms = dict(segmented.elapsed_ms)
            started_s = time.perf_counter()
            if exporter is not None:
                exporter.write_files(segmented.files)
            elapsed_ms["export"] = elapsed_ms.pop("encode") + 1e3 * (time.perf_counter() - started_s)
            if segmented.result is not None:
                view.show(replace(segmented.result, elapsed_ms=elapsed_ms))
            report.add(elapsed_ms)
            feed.progress.segmented(captured, segmented.leaves, elapsed_ms)
