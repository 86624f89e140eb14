"""Which source a run takes, and what it takes instead where no camera is found."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from nurbseg.app.config import AppConfig, SourceConfig, flags
from nurbseg.app.live.replay import Limited, Looped
from nurbseg.drivers.calibration.file import read_camera_file
from nurbseg.drivers.errors import BackendMissingError, DeviceNotFoundError, RecordingFormatError
from nurbseg.drivers.openni2.options import DeviceOptions
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.drivers.settings import described_fields
from nurbseg.drivers.source import FrameSource, Paced

_log = logging.getLogger(__name__)

CAMERA, SYNTHETIC = "openni2:", "synthetic:"
#: Settings that a camera does not heed.
_REPLAY_SETTINGS = ("speed", "loop", "start", "intrinsics", "depth_scale")


@dataclass(frozen=True, slots=True, eq=False)
class OpenedSource:
    """A source as the user wants it: from its start, paced, looped and limited.

    Parameters
    ----------
    source : FrameSource
        To be read; closing it closes all that is behind it.
    uri : str
        What was opened.
    camera : FrameSource
        What is behind it: the camera or recording itself.
    every_frame : bool
        Whether each frame is to be segmented; otherwise the newest.
    looped : Looped or None
        Where a replay starts again at its end, or not; None for a camera.
    """

    source: FrameSource
    uri: str
    camera: FrameSource
    every_frame: bool
    looped: Looped | None = None


def open_chosen(app_config: AppConfig) -> OpenedSource:
    """Open the source that the configuration names, or else a camera, or else the fallback.

    Raises
    ------
    DriverError
        If the source cannot be opened. Only an absent camera leads to the fallback, and only where a
        fallback is named or no source is.
    """
    config = app_config.source
    options = SourceOptions(
        intrinsics=config.intrinsics,
        depth_scale=config.depth_scale,
        association_limit_s=config.association_limit_s,
        device=app_config.camera,
    )
    uri = _named_uri(config)
    if not uri.startswith(CAMERA):
        # A camera reads the file itself; a recording gets its content.
        if app_config.camera.calibration is not None:
            options = replace(options, calibration=read_camera_file(Path(app_config.camera.calibration)))
        _warn_of_camera_settings(uri, app_config.camera)
        return _prepared(uri, app_config, options)
    try:
        return _prepared(uri, app_config, options)
    except (DeviceNotFoundError, BackendMissingError) as err:
        if config.fallback is None and config.named:
            from nurbseg.drivers.doctor.diagnosis import explain_no_camera

            raise DeviceNotFoundError(f"{err}\n{explain_no_camera(uri.removeprefix(CAMERA))}") from err
        instead = config.fallback or demo_uri()
        _log.warning("no camera found: %s", err)
        _log.warning(
            "replaying %s instead (nurbseg-devices doctor explains why no camera was found)", instead
        )
        return _prepared(instead, app_config, options)


def _named_uri(config: SourceConfig) -> str:
    if config.replayed is not None:
        return config.replayed
    device = config.device or "any"
    return device if device.startswith(CAMERA) else f"{CAMERA}{device}"


def demo_uri() -> str:
    """Return where the demo recording lies, or the synthetic source where it was not installed."""
    try:
        recording = files("nurbseg.recordings") / "demo.mcap"
    except ModuleNotFoundError:
        recording = Path("demo.mcap")
    if recording.is_file():
        return str(recording)
    _log.warning("the demo recording is not installed; rendering the synthetic scene")
    return SYNTHETIC


def _prepared(uri: str, app_config: AppConfig, options: SourceOptions) -> OpenedSource:
    """Open a source, and put on top of it what the user wants of a replay."""
    config = app_config.source
    source = camera = _opened_at_start(uri, config, options)
    looped = None
    try:
        every_frame = not source.live and config.speed == 0
        if source.live:
            _warn_of_replay_settings(config)
        else:
            source = looped = Looped(
                source, lambda: _opened_at_start(uri, config, options), repeats=config.loop
            )
        if config.frames is not None or config.duration_s is not None:
            source = Limited(
                source,
                frames=config.frames,
                duration_s=config.duration_s,
                delay_s=app_config.record.delay_s,
            )
        if not source.live and config.speed > 0:
            source = Paced(source, config.speed)
    except BaseException:
        source.close()
        raise
    return OpenedSource(source, uri, camera, every_frame, looped)


def _opened_at_start(uri: str, config: SourceConfig, options: SourceOptions) -> FrameSource:
    source = open_source(uri, options)
    if source.live or not config.start:
        return source
    try:
        passed = source.skip(config.start)
        if passed < config.start:
            raise RecordingFormatError(
                f"{uri}: has {passed} frames, so none is left after --start {config.start}"
            )
    except BaseException:
        source.close()
        raise
    return source


def _warn_of_camera_settings(uri: str, camera: DeviceOptions) -> None:
    heeded = set() if uri.startswith(SYNTHETIC) else {"calibration"}
    if uri.lower().endswith(".oni"):
        heeded |= {"mirror", "registration"}
    _warn_of(
        camera,
        {each.name for each in described_fields(DeviceOptions)} - heeded,
        f"cameras only, ignored for {uri}",
    )


def _warn_of_replay_settings(config: SourceConfig) -> None:
    _warn_of(config, _REPLAY_SETTINGS, "replays only, ignored for a camera")


def _warn_of(config: SourceConfig | DeviceOptions, names: Collection[str], reason: str) -> None:
    """Log which of some settings are not at their defaults."""
    ignored = [
        flags(each)[0]
        for each in described_fields(type(config))
        if each.name in names and getattr(config, each.name) != each.default
    ]
    if ignored:
        _log.warning("%s: for %s", ", ".join(ignored), reason)
