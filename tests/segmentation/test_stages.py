"""The list of stages in docs/architecture.md is what frames alone and live frames pass through."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from rendered import rendered

from nurbseg.common.settings import updated
from nurbseg.drivers.registry import open_source
from nurbseg.library.segmenter import Segmenter, process_frame
from nurbseg.segmentation.config import SegmentationConfig

# The rendered camera is noisier than the one that the default is for.
CONFIG = updated(SegmentationConfig(), extended={"inverse_depth_noise": 2.5e-3})
PROJECT = Path(__file__).parents[2]
_Calls = dict[str, str]
#: Functions for a frame alone and for a live one, and their files.
_Stage = tuple[list[str], list[str], list[str]]


@contextmanager
def calls() -> Iterator[_Calls]:
    """Note the functions that are called, in the order of their last calls, with their files."""
    called: _Calls = {}

    def note(frame: FrameType, event: str, arg: Any) -> None:
        name, _, inner = frame.f_code.co_qualname.partition(".")
        if event == "call" and "segmentation" in frame.f_code.co_filename and "<" not in inner:
            called.pop(name, None)
            called[name] = frame.f_code.co_filename

    sys.setprofile(note)
    try:
        yield called
    finally:
        sys.setprofile(None)


def listed() -> list[_Stage]:
    """Return the functions for frames alone and for live frames, and the files, of each stage."""
    text = (PROJECT / "docs/architecture.md").read_text().partition("| stage |")[2].partition("\n\n")[0]
    rows = [[re.findall(r"`([^`]+)`", cell) for cell in row.split("|")] for row in text.splitlines()[2:]]
    return [(alone, live, files) for _, _, alone, live, files, _ in rows]


def assert_in_files(stages: list[_Stage], column: int, called: _Calls) -> None:
    for stage in stages:
        for name in stage[column]:
            assert name in called, f"{name} is not called"
            assert any(called[name].endswith(file) for file in stage[2]), f"{name} is in {called[name]}"


def test_frames_pass_through_the_listed_stages_in_their_order() -> None:
    stages = listed()
    alone, live = ([name for stage in stages for name in stage[column]] for column in (0, 1))
    with open_source(rendered("frames=12&width=320&height=240")) as source:
        frames = list(source)
    with calls() as called:
        process_frame(frames[0], CONFIG)
    assert_in_files(stages, 0, called)
    assert not set(live) - set(alone) & called.keys()
    assert [name for name in called if name in alone] == alone

    segmenter, seen = Segmenter(CONFIG), _Calls()
    segmenter.process(frames[0])
    for frame in frames[1:]:
        with calls() as called:
            result = segmenter.process(frame)
        assert result.update is not None
        assert result.update.reset == ""
        found = [name for name in called if name in live]
        assert found == [name for name in live if name in called]
        seen |= called
    assert_in_files(stages, 1, seen)
