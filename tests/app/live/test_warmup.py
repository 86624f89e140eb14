"""Warm-up: what a run's first frame would wait for otherwise."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading

import pytest
from rendered import rendered

from nurbseg.app.live import warmup
from nurbseg.app.live.run import _loaded
from nurbseg.app.live.warmup import WarmUp
from nurbseg.app.settings.app_config import AppConfig, SourceConfig
from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.segmentation.config import SegmentationConfig

#: Counts what is loaded by a run's first frames, after the warm-up.
_SCRIPT = """
import sys
from numba.core.caching import Cache

loaded = []
load = Cache.load_overload
def counted(*words):
    loaded.append(words)
    return load(*words)
# Before the functions are decorated.
Cache.load_overload = counted

from nurbseg.app.live.warmup import WarmUp
from nurbseg.library.segmenter import Segmenter
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig

with open_source(sys.argv[1]) as source:
    frames = list(source)
loaded.clear()
WarmUp(SegmentationConfig(), temporal=True).wait()
ahead = len(loaded)
segmenter = Segmenter(SegmentationConfig(), temporal=True)
for frame in frames:
    segmenter.process(frame)
print(ahead, len(loaded) - ahead)
"""


def test_little_is_left_to_load_for_the_first_frames() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, rendered("width=320&height=240&frames=3")],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    ahead, later = map(int, done.stdout.split())
    assert ahead > 40
    assert later < 0.15 * ahead


@pytest.mark.parametrize("method", ["stag15", "nurbseg"])
@pytest.mark.parametrize("temporal", [True, False])
def test_a_warm_up_logs_nothing(method: str, temporal: bool, caplog: pytest.LogCaptureFixture) -> None:
    config = SegmentationConfig(method=method)  # type: ignore[arg-type]
    with caplog.at_level(logging.DEBUG, "nurbseg"):
        WarmUp(config, temporal=temporal).wait()
    assert caplog.records == []


def test_what_goes_wrong_is_left_to_the_run_and_what_hangs_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(index: int) -> None:
        raise ValueError("never mind")

    monkeypatch.setattr(warmup, "_frame", broken)
    with caplog.at_level(logging.DEBUG, "nurbseg"):
        WarmUp(SegmentationConfig(), temporal=False).wait()
    assert [record.levelname for record in caplog.records] == ["DEBUG"]

    released, ended = threading.Event(), threading.Event()

    def hanging(index: int) -> None:
        released.wait(30.0)
        ended.set()

    monkeypatch.setattr(warmup, "_frame", hanging)
    monkeypatch.setattr(warmup, "_WAIT_S", 0.2)
    WarmUp(SegmentationConfig(), temporal=False).wait()
    assert not ended.is_set()
    released.set()


@pytest.mark.parametrize(
    ("config", "begins"),
    [
        (AppConfig(), True),
        (AppConfig(source=SourceConfig(replay="a.mcap")), True),
        (AppConfig(source=SourceConfig(replay="a.mcap", speed=0)), False),
        (AppConfig(source=SourceConfig(speed=0)), True),
        (AppConfig(record=RecordConfig(file="a.mcap", only=True)), False),
    ],
)
def test_it_is_for_runs_that_would_lose_frames(
    config: AppConfig, begins: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nurbseg.app.live.warmup.WarmUp", lambda *_, **__: "warm-up")
    assert _loaded(config) == ["warm-up"] * begins
