import json
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from nurbseg.app.live.report import RunReport, peak_memory_mb
from nurbseg.app.settings.app_config import AppConfig, ExportConfig
from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.drivers.process.messages import Status


def source_of(metadata: Mapping[str, str] = MappingProxyType({}), replaced: int = 0, **status: Any) -> Any:
    return SimpleNamespace(metadata=metadata, replaced=replaced, live=False, status=Status(**status))


def report_of(config: AppConfig = AppConfig(), **source: Any) -> RunReport:  # noqa: B008
    return RunReport(config, "scripted", source_of(**source))


def test_every_frame_is_accounted_for() -> None:
    metadata, damaged = {"dropped": "3", "device": "none"}, ("b: bad",)
    report = report_of(metadata=metadata, replaced=3, read=4, damaged=1, damaged_frames=damaged)
    report.add({"segment": 5.0}, objects=13)
    frames = report.document("the source ended")["frames"]
    assert (frames["read"], frames["segmented"]) == (4, 1)
    assert {why: count for why, count in frames["dropped"].items() if count} == {
        "overwritten_by_a_newer_frame": 3,
        "damaged": 1,
        "without_a_partner": 3,
    }
    assert frames["damaged_frames"] == ["b: bad"]
    report.late, report.view = 2, MagicMock(dropped=5)
    assert report.summary() == (
        "1 frame segmented, 13 objects in the last; 3 overwritten by newer ones, 1 damaged, "
        "2 too late to be shown, 5 dropped by the slow viewer"
    )


@pytest.mark.parametrize(("read", "text"), [(4, "4 frames read"), (1, "1 frame read")])
def test_frames_that_were_only_recorded_are_counted(read: int, text: str) -> None:
    report = report_of(AppConfig(record=RecordConfig(file="a.mcap", only=True)), read=read)
    assert report.summary() == text


def test_frames_that_the_camera_lost_or_that_were_not_segmented_are_counted() -> None:
    losses = {"missed": 4}
    report = report_of(replaced=3, read=9, losses=losses)
    report.add({"segment": 5.0})
    frames = report.document("quit")["frames"]
    assert frames["camera"] == losses
    assert {why: count for why, count in frames["dropped"].items() if count} == {
        "overwritten_by_a_newer_frame": 3,
        "unfinished_at_the_end": 5,
    }


def test_latencies_are_reported_as_percentiles() -> None:
    report = report_of()
    for value in range(1, 102):
        report.add({"segment": float(value)})
    stages = report.document("")["latency_ms"]
    assert stages == {"segment": {"p50": 51.0, "p95": 96.0, "p99.9": 100.9, "max": 101.0}}


def test_the_file_holds_configuration_versions_and_memory(tmp_path: Path) -> None:
    file = tmp_path / "new" / "report.json"
    config = AppConfig(export=ExportConfig(report=str(file)))
    report = report_of(config, metadata={"device": "none"})
    report.write("interrupted")
    document = json.loads(file.read_text())
    assert document["ended"] == "interrupted"
    assert document["source"] == {"opened": "scripted", "device": "none"}
    assert document["configuration"]["segmentation"]["metric"] == AppConfig().segmentation.metric
    assert document["versions"]["numpy"][0].isdigit()
    assert document["frames_per_s"] == 0.0
    assert document["peak_memory_mb"]["segmentation"] > 10
    assert document["peak_memory_mb"]["view"] == 0


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_peak_memory_is_what_the_kernel_says() -> None:
    block = bytearray(100_000_000)
    block[::4096] = b"x" * len(block[::4096])
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line]
    assert peak_memory_mb() == pytest.approx(int(line.split()[1]) * 1024 / 1e6, abs=5.0)


@pytest.mark.parametrize("frames", [0, 1])
def test_a_rate_needs_two_frames(frames: int) -> None:
    report = report_of()
    for _ in range(frames):
        report.add({"segment": 1.0})
    assert report.frames_per_s == 0.0
    assert "frames/s" not in report.summary()


def test_the_rate_is_that_of_the_frames_after_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    report = report_of()
    # Half a second from frame to frame; the first one took longer.
    moments_s = iter([100.0, 100.5, 101.0, 101.5, 102.0])
    monkeypatch.setattr("nurbseg.app.live.report.time", MagicMock(monotonic=lambda: next(moments_s)))
    for _ in range(5):
        report.add({"segment": 1.0})
    assert report.summary() == "5 frames segmented, 2.00 frames/s"


def test_whether_compiled_code_is_kept_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    report = report_of()
    assert report.document("quit")["compiled_code"] == {"kept": True, "reason": ""}
    monkeypatch.setattr("nurbseg.app.live.report.cache_error", lambda: "the disk is full")
    assert report.document("quit")["compiled_code"] == {"kept": False, "reason": "the disk is full"}
