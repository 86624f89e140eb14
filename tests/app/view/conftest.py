"""One segmented frame for all views, and no warning of Rerun's goes unseen."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from nurbseg.library.result import FrameResult
from tests.fakes.small_scene import small_result


@pytest.fixture(autouse=True, scope="module")
def strict() -> Iterator[None]:
    """Make an error of what Rerun would only warn of, in the process that shows and saves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RERUN_STRICT", "1")
        yield


@pytest.fixture(scope="session")
def result() -> FrameResult:
    return small_result()
