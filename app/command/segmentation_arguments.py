"""Source options and settings from the arguments of nurbseg-eval and nurbseg-batch."""

import argparse
import logging

from nurbseg.app.command.config_file import read_config
from nurbseg.app.settings.app_config import AppConfig, SourceConfig
from nurbseg.common.settings import assigned, changed_paths, updated
from nurbseg.drivers.options import SourceOptions
from nurbseg.segmentation.config import SegmentationConfig

_log = logging.getLogger("nurbseg.config")

#: Settings of a configuration file that change the results of nurbseg-live, but are not applied here.
_LIVE_ONLY = ("depth.", "source.intrinsics", "source.depth_scale", "source.association", "camera.calibration")


def source_options(given: argparse.Namespace) -> SourceOptions:
    """Return the options for recordings without calibration; raises ValueError if one is wrong."""
    intrinsics = given.intrinsics and assigned(SourceConfig, f"intrinsics={given.intrinsics}")[1]
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
    chosen = {} if given.seed is None else {"seed": given.seed}
    chosen |= dict(assigned(SegmentationConfig, text) for text in given.settings)
    config: SegmentationConfig = updated(file.segmentation, **chosen)
    return config
