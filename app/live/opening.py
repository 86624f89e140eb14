"""Opens the source of a run, or a fallback if no camera is found."""

import logging
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from nurbseg.app.settings.app_config import AppConfig, SourceConfig, flags
from nurbseg.app.view.viewer import chosen_mode
from nurbseg.common.errors import BackendMissingError, DeviceNotFoundError
from nurbseg.common.process.child import ChildProcess
from nurbseg.common.settings import described_fields
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.process.client import SourceProcess
from nurbseg.drivers.process.messages import Playback

_log = logging.getLogger(__name__)

CAMERAS = ("openni2:", "realsense:")
#: Settings that do not apply to cameras.
_REPLAY_SETTINGS = ("speed", "loop", "start", "intrinsics", "depth_scale", "depth_topic", "color_topic")


@dataclass(frozen=True, slots=True, eq=False)
class OpenedSource:
    """A source, played as configured."""

    source: SourceProcess
    uri: str
    #: Whether each frame is to be segmented, or only the newest.
    every_frame: bool
    #: Whether it is replayed with --speed 0: frames do not continue each other unless that is set.
    apart: bool


def open_chosen(
    app_config: AppConfig,
    process: ChildProcess | None = None,
    meanwhile: Callable[[], object] = lambda: None,
) -> OpenedSource:
    """Open the configured source, or else a camera, or else the fallback.

    `process` runs the program of the source already; `meanwhile` is called while it opens the source. The
    fallback replaces a missing camera only if it was configured or no source was. Raises DriverError if the
    source cannot be opened.
    """
    config = app_config.source
    options = SourceOptions(
        intrinsics=config.intrinsics,
        depth_scale=config.depth_scale,
        association_limit_s=config.association_limit_s,
        depth_topic=config.depth_topic,
        color_topic=config.color_topic,
        device=app_config.camera,
        memory_mb=config.source_memory_mb,
    )
    uri = _named_uri(config)
    if config.replayed is not None and not uri.startswith(CAMERAS):
        # A camera reads the file itself.
        if app_config.camera.calibration is not None:
            options = replace(options, calibration=Path(app_config.camera.calibration))
            # Also if the source does not need it.
            options.given_cameras()
        heeded = {"calibration"}
        if uri.lower().endswith(".oni"):
            heeded |= {"mirror", "registration"}
        ignored = {field.name for field in described_fields(DeviceOptions)} - heeded
        _warn_of_ignored(app_config.camera, ignored, f"cameras only, ignored for {uri}")
        return _prepared(uri, app_config, options, process=process, meanwhile=meanwhile)
    try:
        return _prepared(uri, app_config, options, process=process, meanwhile=meanwhile)
    except (DeviceNotFoundError, BackendMissingError) as err:
        if config.fallback is None and config.named:
            raise DeviceNotFoundError(f"{err}{_explanation(uri)}") from err
        instead = config.fallback or demo_uri()
        _log.warning("no camera found: %s", err)
        _log.warning(
            "replaying %s instead (nurbseg-devices doctor explains why no camera was found)", instead
        )
        return _prepared(instead, app_config, options)


def _explanation(uri: str) -> str:
    """Return what is said of a camera that is not there, on lines of its own after the error."""
    if not uri.startswith(CAMERAS):
        return ""
    if uri.startswith(CAMERAS[1]):
        return "\nTo find out why: nurbseg-devices doctor --device realsense"
    from nurbseg.drivers.doctor.diagnosis import explain_no_camera

    return f"\n{explain_no_camera(uri.removeprefix(CAMERAS[0]))}"


def _named_uri(config: SourceConfig) -> str:
    return _camera_uri(config.device or "any") if config.replayed is None else config.replayed


def _camera_uri(device: str) -> str:
    if device == "realsense":
        return "realsense:"
    scheme, separator, _ = device.partition(":")
    if device.startswith(CAMERAS):
        return device
    from nurbseg.drivers.plugins import registered_schemes

    return device if separator and scheme in registered_schemes() else f"{CAMERAS[0]}{device}"


def demo_uri() -> str:
    """Return the path of the demo recording."""
    return str(files("nurbseg.recordings") / "demo.mcap")


def _prepared(
    uri: str,
    app_config: AppConfig,
    options: SourceOptions,
    **early: Any,
) -> OpenedSource:
    """Open a source and apply the settings for replays."""
    config = app_config.source
    source = SourceProcess(
        uri,
        options,
        playback=Playback(
            speed=_pace(app_config),
            loop=config.loop,
            start=config.start,
            frames=config.frames,
            duration_s=config.duration_s,
            delay_s=app_config.record.delay_s,
        ),
        # Every frame only of a recording, and none if it is only recorded.
        every=None if app_config.every_frame and not app_config.record.only else False,
        **early,
    )
    if source.depth_unit is not None:
        _log.info("depth: %s", source.depth_unit)
    if source.live:
        _warn_of_ignored(config, _REPLAY_SETTINGS, "replays only, ignored for a camera")
    return OpenedSource(
        source,
        uri,
        every_frame=not source.live and app_config.every_frame,
        apart=not source.live and config.speed == 0,
    )


def _pace(config: AppConfig) -> float | None:
    """Return the speed of a replay; None for as fast as frames are segmented."""
    if config.source.speed is not None:
        return config.source.speed or None
    return None if config.every_frame and chosen_mode(config.shown) == "none" else 1.0


def _warn_of_ignored(config: SourceConfig | DeviceOptions, names: Collection[str], reason: str) -> None:
    """Warn of settings that are ignored but not at their defaults."""
    ignored = [
        flags(field)[0]
        for field in described_fields(type(config))
        if field.name in names and getattr(config, field.name) != field.default
    ]
    if ignored:
        _log.warning("%s: for %s", ", ".join(ignored), reason)


@contextmanager
def watched(replay: str | None) -> Iterator[None]:
    """Warn after the block if the replayed file is gone, which does not affect reading."""
    is_file = replay is not None and Path(replay).is_file()
    try:
        yield
    finally:
        if replay is not None and is_file and not Path(replay).exists():
            _log.warning("%s was deleted or moved while it was replayed", replay)
