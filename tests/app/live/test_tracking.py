"""A run whose frames continue each other."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import cv2
import pytest
from rendered import rendered

from nurbseg.library.rate_controller import RateController
from nurbseg.segmentation.live.tree import Budget

Live = Callable[..., CompletedProcess[str]]


def test_a_run_says_how_long_each_frame_waited(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits_ms: list[float] = []

    class Listening(RateController):
        def budget(self, waited_ms: float = 0.0) -> Budget:
            waits_ms.append(waited_ms)
            return super().budget(waited_ms)

    monkeypatch.setattr("nurbseg.library.segmenter.RateController", Listening)
    source = rendered("width=160&height=120&frames=5")
    done = live("--replay", source, "--view", "none", "--report", "report.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert len(waits_ms) == report["frames"]["segmented"]
    assert report["latency_ms"]["wait"]["max"] == pytest.approx(max(waits_ms), abs=1e-3)
    assert min(waits_ms) > 0


def test_opencv_does_not_compete_with_the_other_threads_of_a_run(live: Live) -> None:
    cv2.setNumThreads(2)
    done = live("--replay", rendered("width=160&height=120&frames=1"), "--view", "none")
    assert done.returncode == 0, done.stderr
    assert cv2.getNumThreads() == 1


def test_a_run_exports_stable_labels_and_counts_events(
    live: Live, write_pairs: Callable[..., Path], tmp_path: Path
) -> None:
    done = live(
        *("--replay", str(write_pairs(3)), "--speed", "0", "--view", "none", "--temporal", "on"),
        *("--depth-max", "1", "--export", "out", "--report", "report.json"),
    )
    assert done.returncode == 0, done.stderr
    boxes = []
    for index in range(3):
        labels = cv2.imread(str(tmp_path / f"out/{index:06d}_labels.png"), cv2.IMREAD_UNCHANGED)
        boxes.append(int(labels[24, 22 + index]))
    assert len(set(boxes)) == 1
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["events"] == {"new": 2}
    assert report["latency_ms"]["identify"]["p50"] > 0
