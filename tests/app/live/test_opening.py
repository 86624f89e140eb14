from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rendered import rendered

from nurbseg.app.live import opening
from nurbseg.app.live.opening import demo_uri, open_chosen
from nurbseg.app.settings.app_config import AppConfig, SourceConfig
from nurbseg.app.settings.output_config import ExportConfig, ViewConfig
from nurbseg.common.errors import (
    BackendMissingError,
    CalibrationError,
    DeviceNotFoundError,
    DriverError,
)
from nurbseg.drivers.options import DeviceOptions
from nurbseg.drivers.process.client import SourceProcess

SMALL = rendered("width=32&height=24&frames=5")


def chosen(**source: object) -> AppConfig:
    return AppConfig(source=SourceConfig(**source))  # type: ignore[arg-type]


@pytest.fixture
def no_camera(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let no camera be found, whatever is connected to this computer; return the URIs asked for."""
    asked: list[str] = []

    def open_without_camera(uri: str, *arguments: Any, **settings: Any) -> SourceProcess:
        asked.append(uri)
        if uri.startswith("openni2:"):
            raise DeviceNotFoundError("no camera is connected")
        return SourceProcess(uri, *arguments, **settings)

    monkeypatch.setattr(opening, "SourceProcess", open_without_camera)
    return asked


@pytest.fixture
def a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a camera be found."""

    def open_camera(uri: str, *_: Any, **settings: Any) -> Any:
        assert uri.startswith("openni2:")
        return SimpleNamespace(live=True, depth_unit=None, settings=settings)

    monkeypatch.setattr(opening, "SourceProcess", open_camera)


@pytest.mark.parametrize(
    ("speed", "export", "view", "expected"),
    [
        (None, None, ViewConfig("none"), (1.0, False)),
        (None, "out", ViewConfig("none"), (None, True)),
        (None, None, ViewConfig("none", save="a.rrd"), (None, True)),
        (None, "out", ViewConfig("serve"), (1.0, True)),
        (None, None, ViewConfig("serve", save="a.rrd"), (1.0, True)),
        (2.0, "out", ViewConfig("none"), (2.0, False)),
        (0.0, None, ViewConfig("serve"), (None, True)),
    ],
)
def test_results_in_files_are_of_every_frame_at_a_pace_that_a_viewer_can_follow(
    speed: float | None, export: str | None, view: ViewConfig, expected: tuple[float | None, bool]
) -> None:
    config = replace(chosen(replay=SMALL, speed=speed), export=ExportConfig(export), view=view)
    opened = open_chosen(config)
    with opened.source:
        assert (opened.source.speed, opened.every_frame) == expected


def test_without_a_source_a_camera_is_taken(a_camera: None) -> None:
    opened = open_chosen(chosen())
    assert opened.uri == "openni2:any"
    assert opened.source.live
    assert not opened.every_frame


def test_without_a_source_and_a_camera_the_demo_is_replayed_and_that_is_said(
    no_camera: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    opened = open_chosen(chosen())
    opened.source.close()
    assert no_camera[0] == "openni2:any"
    assert opened.uri == demo_uri()
    assert "no camera found" in caplog.text
    assert f"replaying {opened.uri} instead" in caplog.text


def test_openni_absent_does_not_break_the_first_start(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def open_without_library(uri: str, *_: Any, **__: Any) -> Any:
        if uri.startswith("openni2:"):
            raise BackendMissingError("install libopenni2-0")
        return SimpleNamespace(live=False, depth_unit=None)

    monkeypatch.setattr(opening, "SourceProcess", open_without_library)
    assert open_chosen(chosen()).uri.endswith("demo.mcap")
    assert "install libopenni2-0" in caplog.text


@pytest.mark.parametrize("device", [None, "xtion"])
def test_the_fallback_takes_the_place_of_a_camera(device: str | None, no_camera: list[str]) -> None:
    opened = open_chosen(chosen(device=device, fallback=SMALL))
    opened.source.close()
    assert no_camera == [f"openni2:{device or 'any'}", SMALL]
    assert opened.uri == SMALL


def test_a_named_camera_that_is_absent_is_an_error_with_the_doctors_finding(no_camera: list[str]) -> None:
    with pytest.raises(DeviceNotFoundError, match=r"no camera is connected(.|\n)*nurbseg-devices doctor"):
        open_chosen(chosen(device="xtion"))
    assert no_camera == ["openni2:xtion"]


def test_a_device_may_be_named_by_its_uri(no_camera: list[str]) -> None:
    with pytest.raises(DeviceNotFoundError):
        open_chosen(chosen(device="openni2:1d27/0601@3/2"))
    assert no_camera == ["openni2:1d27/0601@3/2"]


def test_a_camera_that_fails_leads_to_no_fallback(monkeypatch: pytest.MonkeyPatch) -> None:
    def open_broken(*_: Any, **__: Any) -> Any:
        raise DriverError("the camera does not know this mode")

    monkeypatch.setattr(opening, "SourceProcess", open_broken)
    with pytest.raises(DriverError, match="mode"):
        open_chosen(chosen(fallback=SMALL))


def test_a_missing_recording_leads_to_no_fallback(no_camera: list[str], tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFoundError, match=r"none\.mcap"):
        open_chosen(chosen(replay=str(tmp_path / "none.mcap"), fallback=SMALL))


def test_as_fast_as_possible_means_every_frame() -> None:
    for speed, every_frame in ((0.0, True), (1.0, False)):
        opened = open_chosen(chosen(replay=SMALL, speed=speed))
        opened.source.close()
        assert opened.every_frame is every_frame


def test_start_and_frames_choose_a_part_of_a_replay() -> None:
    with open_chosen(chosen(replay=SMALL, speed=0.0, start=2, frames=2)).source as source:
        assert [frame.index for frame in source] == [2, 3]


def test_a_loop_repeats_what_comes_after_the_start() -> None:
    with open_chosen(chosen(replay=SMALL, speed=0.0, start=3, frames=5, loop=True)).source as source:
        frames = list(source)
    assert [frame.index for frame in frames] == [3, 4, 5, 6, 7]
    assert (frames[0].depth_mm == frames[2].depth_mm).all()
    assert (frames[0].depth_mm != frames[1].depth_mm).any()


def test_a_camera_warns_of_ignored_settings_of_a_replay(
    a_camera: None, caplog: pytest.LogCaptureFixture
) -> None:
    open_chosen(chosen(device="any", loop=True, start=3, speed=0.0))
    assert "--speed, --loop, --start: for replays only" in caplog.text
    open_chosen(chosen(device="any", intrinsics=(60.0, 61.0, 31.5, 23.5)))
    assert "--intrinsics: for replays only" in caplog.text


def test_settings_of_a_camera_are_said_to_be_ignored_for_other_sources(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    camera = DeviceOptions(mirror=True, depth_mode="qvga")
    open_chosen(AppConfig(source=SourceConfig(replay=SMALL), camera=camera)).source.close()
    assert f"--depth-mode, --mirror: for cameras only, ignored for {SMALL}" in caplog.text
    caplog.clear()
    with pytest.raises(DeviceNotFoundError):
        open_chosen(AppConfig(source=SourceConfig(replay=str(tmp_path / "x.oni")), camera=camera))
    assert "--depth-mode: for cameras only" in caplog.text


def test_intrinsics_and_depth_scale_reach_the_recording(write_pairs: Callable[..., Path]) -> None:
    folder = write_pairs(camera=False)
    with pytest.raises(CalibrationError, match="intrinsics"):
        open_chosen(chosen(replay=str(folder)))
    config = chosen(replay=str(folder), intrinsics=(60.0, 61.0, 31.5, 23.5), depth_scale=2000.0, speed=0.0)
    with open_chosen(config).source as source:
        frame = source.read()
    assert frame.calibration.depth.fy == 61.0
    assert set(frame.depth_mm.ravel().tolist()) == {600, 1000}


def test_a_calibration_file_serves_a_recording(write_pairs: Callable[..., Path], tmp_path: Path) -> None:
    folder = write_pairs(camera=False)
    path = tmp_path / "camera.toml"
    path.write_text(
        "registered = true\n[depth]\nwidth = 64\nheight = 48\nfx = 70.0\nfy = 70.0\ncx = 31.5\ncy = 23.5\n"
    )
    config = AppConfig(source=SourceConfig(replay=str(folder)), camera=DeviceOptions(calibration=str(path)))
    with open_chosen(config).source as source:
        assert source.calibration.depth.fx == 70.0


def test_a_calibration_file_without_image_sizes_takes_those_of_the_recording(
    write_pairs: Callable[..., Path], tmp_path: Path
) -> None:
    folder = write_pairs(camera=False)
    path = tmp_path / "intrinsics.txt"
    path.write_text("70 0 31.5\n0 71 23.5\n0 0 1\n")
    config = AppConfig(source=SourceConfig(replay=str(folder)), camera=DeviceOptions(calibration=str(path)))
    with open_chosen(config).source as source:
        camera = source.calibration.color
    assert (camera.width, camera.height, camera.fx, camera.fy) == (64, 48, 70.0, 71.0)
