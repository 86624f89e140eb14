"""What every test is held to: no thread and no source may be left open. And where real data lies."""

from __future__ import annotations

import functools
import gc
import logging
import os
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from session_end import pytest_sessionfinish, pytest_unconfigure

from scene.source import SyntheticOptions, SyntheticSource

# As in the commands, and before numpy is imported: on a busy computer, threads that wait for each other at
# every small product take many times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from nurbseg.drivers.source import FrameSource
from nurbseg.library.result import FrameResult

__all__ = [
    "log_level",
    "nothing_is_left_open",
    "pytest_sessionfinish",
    "pytest_unconfigure",
    "real_data",
    "small_result",
]

# How fast examples are computed says nothing on a busy computer.
settings.register_profile("any speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any speed")

# Tests send these to programs that they start, which ignore what is ignored here: in a shell's background.
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, usual)

#: How long a thread may take to end after its test, seconds.
_GRACE_S = 10.0
_DATA_VARIABLE = "NURBSEG_DATA"


@pytest.fixture(autouse=True)
def nothing_is_left_open(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    opened: list[weakref.ref[FrameSource]] = []
    construct = FrameSource.__init__

    @functools.wraps(construct)
    def construct_and_remember(source: FrameSource, *args: Any, **options: Any) -> None:
        construct(source, *args, **options)
        opened.append(weakref.ref(source))

    monkeypatch.setattr(FrameSource, "__init__", construct_and_remember)
    before = set(threading.enumerate())
    yield
    deadline_s = time.monotonic() + _GRACE_S
    threads = [each for each in threading.enumerate() if each not in before and not each.daemon]
    for thread in threads:
        thread.join(max(0.0, deadline_s - time.monotonic()))
    alive = [thread.name for thread in threads if thread.is_alive()]
    assert not alive, f"threads left running: {alive}"
    if left_open(opened):
        # A source whose construction failed may live on in the traceback of the error.
        gc.collect()
    assert not left_open(opened), f"sources left open: {left_open(opened)}"
    if libraries_in_use():
        gc.collect()
    while libraries_in_use() and time.monotonic() < deadline_s:
        time.sleep(0.05)
    assert not libraries_in_use(), f"still initialized: {libraries_in_use()}"


def left_open(sources: list[weakref.ref[FrameSource]]) -> list[FrameSource]:
    return [source for each in sources if (source := each()) is not None and not source._closed]


def libraries_in_use() -> list[str]:
    """Return the copies of OpenNI2 that are initialized: the next test's cameras would not be seen."""
    module = sys.modules.get("nurbseg.drivers.openni2.library")
    return [] if module is None else [path for path, library in module._loaded.items() if library._users]


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """Return a function that finds a folder of real recordings by name, or skips the test."""

    def find(name: str) -> Path:
        root = os.environ.get(_DATA_VARIABLE)
        if not root:
            pytest.skip(f"{_DATA_VARIABLE} names no folder of real recordings, needed: {name}")
        folder = Path(root) / name
        if not folder.exists():
            pytest.skip(f"{folder} does not exist")
        return folder

    return find


@pytest.fixture(scope="session")
def small_result() -> FrameResult:
    """The first frame of the rendered scene at 160 x 120 pixels, segmented as the paper does."""
    from nurbseg.library.segmenter import process_frame
    from nurbseg.segmentation.config import SegmentationConfig

    with SyntheticSource(SyntheticOptions(width=160, height=120, frames=1)) as source:
        return process_frame(source.read(), SegmentationConfig(method="stag15"))


@pytest.fixture(autouse=True)
def log_level() -> Iterator[None]:
    """Restore the level of the log, which commands that run in this process set."""
    logger = logging.getLogger("nurbseg")
    level = logger.level
    yield
    logger.setLevel(level)
