"""Source options and settings from the arguments of nurbseg-eval and nurbseg-batch."""

import argparse
import logging
from typing import Any

from nurbseg.app.command.config_file import read_config
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.common.settings import changed_paths, nested, setting_paths, updated, value_kind
from nurbseg.drivers.options import SourceOptions
from nurbseg.segmentation.config import SegmentationConfig


def setting_value(name: str, text: str) -> Any:
    """Return the value of a setting, given by name or symbol (``lambda``), from a text.

    Raises ValueError if there is no such setting, or the value is invalid.
    """
    path = path_named(name)
    try:
        value = value_kind(SegmentationConfig, path).from_text(text)
    except ValueError as err:
        raise ValueError(f"{name}: {err}") from None
    updated(SegmentationConfig(), **nested({path: value}))
    return value


def path_named(name: str) -> str:
    """Return the path (``stag15.control_points``) of a setting by its name or symbol."""
    wanted = name.replace("-", "_")
    for path, field in setting_paths(SegmentationConfig):
        if wanted in (path, field.name, field.metadata["symbol"]):
            return path
    known = ", ".join(field.name for _, field in setting_paths(SegmentationConfig))
    raise ValueError(f"{name}: no such setting; available: {known}")


_log = logging.getLogger("nurbseg.config")

#: Settings of a configuration file that change the results of nurbseg-live, but are not applied here.
_LIVE_ONLY = ("depth.", "source.intrinsics", "source.depth_scale", "source.association", "camera.calibration")


def source_options(given: argparse.Namespace) -> SourceOptions:
    """Return the options for recordings without calibration; raises ValueError if one is wrong."""
    intrinsics = None
    if given.intrinsics is not None:
        try:
            fx, fy, cx, cy = (float(word) for word in given.intrinsics.split(","))
        except ValueError:
            raise ValueError(f"--intrinsics {given.intrinsics}: expected FX,FY,CX,CY in pixels") from None
        intrinsics = (fx, fy, cx, cy)
    options = SourceOptions(
        intrinsics=intrinsics, depth_scale=given.depth_scale, calibration=given.calibration
    )
    # Now, and not once for each recording, if the file cannot be read.
    options.given_cameras()
    return options


def base_config(given: argparse.Namespace) -> SegmentationConfig:
    """Return the settings of the segmentation; warn of others in the file that would change the results."""
    file = AppConfig() if given.config is None else read_config(given.config)
    if ignored := [path for path in changed_paths(file) if path.startswith(_LIVE_ONLY)]:
        _log.warning("%s: %s: only nurbseg-live applies this", given.config, ", ".join(ignored))
    config = file.segmentation
    chosen: dict[str, Any] = {} if given.seed is None else {"seed": given.seed}
    for text in given.settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"--set {text}: expected NAME=VALUE")
        chosen[path_named(name)] = setting_value(name, value)
    result: SegmentationConfig = updated(config, **nested(chosen))
    return result
