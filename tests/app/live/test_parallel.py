import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rendered import rendered

from nurbseg.app.errors import FrameFailedError
from nurbseg.app.live.parallel import segment_alone, segment_in_parallel
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from tests.fakes.saved_view import read_saved_view


def small(frames: int) -> str:
    return rendered(f"width=96&height=72&frames={frames}")


def frames_of(count: int) -> Iterator[RGBDFrame]:
    with open_source(small(count)) as source:
        yield from source


def test_files_do_not_depend_on_the_number_of_processes(live: Callable, tmp_path: Path) -> None:
    words = ["--replay", small(7), "--speed", "0", "--view", "none", "--export-surfaces"]
    words += ["--export-objects", "--export-preview"]
    for name, more in (("alone", []), ("shared", ["--workers", "2"])):
        done = live(*words, "--export", name, *more)
        assert done.returncode == 0, done.stderr
    alone, shared = (
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("alone", "shared")
    )
    assert len(alone) == 7 * 7 + 2
    assert shared == alone


def test_what_several_processes_segmented_is_shown(live: Callable, tmp_path: Path) -> None:
    done = live("--replay", small(4), "--speed", "0", "--save", "a.rrd", "--view", "none", "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert read_saved_view(tmp_path / "a.rrd").frames("tree") == list(range(4))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--speed", "1"], "--workers: only for replays of every frame: no camera, and --speed 0"),
        (["--speed", "0", "--temporal", "on"], "use --temporal off"),
        (["--speed", "0", "--workers", "0"], "expected a whole number or auto, at least 1, got 0"),
        (["--speed", "0", "--workers", "many"], "expected a whole number or auto, at least 1, got 'many'"),
    ],
)
def test_workers_are_refused_where_frames_wait_for_each_other(
    live: Callable, words: list[str], said: str
) -> None:
    done = live("--replay", small(2), "--view", "none", "--workers", "2", *words)
    assert done.returncode == 2
    assert said in done.stderr


def test_a_frame_that_cannot_be_segmented_is_named() -> None:
    results = segment_in_parallel(
        frames_of(3),
        "no configuration",  # type: ignore[arg-type]
        count=2,
        export=None,
        whole=False,
    )
    with pytest.raises(
        FrameFailedError, match=r"frame 0 .*cannot be segmented: unexpected failure: TypeError"
    ):
        next(results)


def test_frames_are_read_as_there_is_room_for_them() -> None:
    read = 0

    def frames() -> Iterator[RGBDFrame]:
        nonlocal read
        for frame in frames_of(12):
            read += 1
            yield frame

    results = segment_in_parallel(frames(), SegmentationConfig(), count=2, export=ExportConfig(), whole=False)
    for number, (frame, segmented) in zip(itertools.count(), results, strict=False):
        assert frame.index == number
        assert read <= number + 4
        assert f"{number:06d}_tree.json" in segmented.files
        assert segmented.result is None
    assert read == 12


def test_the_latency_is_that_since_the_frame_arrived_and_what_no_stage_took_was_waiting() -> None:
    # So long ago that a thousandth of it is longer than the work.
    frames = (replace(frame, arrived_s=time.monotonic() - 1e6) for frame in frames_of(1))
    begun_s = time.monotonic()
    ((_, segmented),) = segment_in_parallel(frames, SegmentationConfig(), count=1, export=None, whole=False)
    took_ms = 1e3 * (time.monotonic() - begun_s)
    latency_ms = segmented.elapsed_ms["capture_to_labels"]
    assert 1e9 <= latency_ms <= 1e9 + took_ms
    stages_ms = sum(segmented.elapsed_ms.values()) - latency_ms
    assert stages_ms == pytest.approx(latency_ms, abs=0.01, rel=0)
    worked_ms = stages_ms - segmented.elapsed_ms["wait"]
    assert 0 < worked_ms < took_ms


def test_encoding_is_a_part_of_the_time_that_a_frame_takes() -> None:
    (frame,) = frames_of(1)
    begun_s = time.perf_counter()
    segmented = segment_alone(frame, SegmentationConfig(), export=ExportConfig())
    took_ms = 1e3 * (time.perf_counter() - begun_s)
    stages_ms = {name: each for name, each in segmented.elapsed_ms.items() if name != "encode"}
    assert 0 < segmented.elapsed_ms["encode"] <= took_ms - max(stages_ms.values())
