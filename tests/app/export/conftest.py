"""A frame of which objects are known to be merged, for all that is written of it."""

from __future__ import annotations

import pytest

from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame


@pytest.fixture(scope="session")
def merged(small_result: FrameResult) -> FrameResult:
    """The frame of `small_result`, segmented by the default method."""
    result = process_frame(small_result.frame)
    assert 3 < len(result.tree.objects) < len(result.tree.leaves())
    return result
