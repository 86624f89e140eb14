import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nurbseg.app.export.config import ExportConfig
from nurbseg.app.live.capture import Captured
from nurbseg.app.live.parallel import FrameFailedError, segment_in_parallel
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from tests.fakes.saved_view import read_saved_view

SMALL = "synthetic:?width=96&height=72&frames={}"


def captured_frames(count: int) -> Iterator[Captured]:
    with open_source(SMALL.format(count)) as source:
        for frame in source:
            yield Captured(frame, 0.0)


def test_files_do_not_depend_on_the_number_of_processes(live: Callable, tmp_path: Path) -> None:
    words = ["--replay", SMALL.format(7), "--speed", "0", "--view", "none", "--export-surfaces"]
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
    done = live(
        "--replay", SMALL.format(4), "--speed", "0", "--save", "a.rrd", "--view", "none", "--workers", "2"
    )
    assert done.returncode == 0, done.stderr
    assert read_saved_view(tmp_path / "a.rrd").frames("tree") == list(range(4))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--speed", "1"], "--workers: only for replays of every frame: no camera, and --speed 0"),
        (["--speed", "0", "--temporal", "on"], "use --temporal off"),
        (["--speed", "0", "--workers", "0"], "expected at least 1, got 0"),
        (["--speed", "0", "--workers", "many"], "expected a whole number or auto, got 'many'"),
    ],
)
def test_workers_are_refused_where_frames_wait_for_each_other(
    live: Callable, words: list[str], said: str
) -> None:
    done = live("--replay", SMALL.format(2), "--view", "none", "--workers", "2", *words)
    assert done.returncode == 2
    assert said in done.stderr


def test_a_frame_that_cannot_be_segmented_is_named() -> None:
    results = segment_in_parallel(
        captured_frames(3),
        "no configuration",  # type: ignore[arg-type]
        count=2,
        export=None,
        whole=False,
    )
    with pytest.raises(
        FrameFailedError, match=r"frame 0 .*cannot be segmented: unexpected failure: AttributeError"
    ):
        next(results)


def test_frames_are_read_as_there_is_room_for_them() -> None:
    read = 0

    def frames() -> Iterator[Captured]:
        nonlocal read
        for each in captured_frames(12):
            read += 1
            yield each

    results = segment_in_parallel(frames(), SegmentationConfig(), count=2, export=ExportConfig(), whole=False)
    for number, (captured, segmented) in zip(itertools.count(), results, strict=False):
        assert captured.frame.index == number
        assert read <= number + 4
        assert f"{number:06d}_tree.json" in segmented.files
        assert segmented.result is None
    assert read == 12
