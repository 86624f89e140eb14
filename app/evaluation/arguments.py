"""Source options and settings from the arguments of nurbseg-eval and nurbseg-batch."""

from __future__ import annotations

import argparse
from typing import Any

from nurbseg.app.command.config_file import read_config
from nurbseg.app.evaluation.variants import path_named, setting_value
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.settings import nested, updated
from nurbseg.segmentation.config import SegmentationConfig


def source_options(given: argparse.Namespace) -> SourceOptions:
    """Return the options for recordings without calibration."""
    intrinsics = None
    if given.intrinsics is not None:
        try:
            fx, fy, cx, cy = (float(each) for each in given.intrinsics.split(","))
        except ValueError:
            raise ValueError(f"--intrinsics {given.intrinsics}: expected FX,FY,CX,CY in pixels") from None
        intrinsics = (fx, fy, cx, cy)
    return SourceOptions(intrinsics=intrinsics, depth_scale=given.depth_scale)


def base_config(given: argparse.Namespace) -> SegmentationConfig:
    """Return the settings of the segmentation."""
    config = SegmentationConfig() if given.config is None else read_config(given.config).segmentation
    chosen: dict[str, Any] = {} if given.seed is None else {"seed": given.seed}
    for text in given.settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"--set {text}: expected NAME=VALUE")
        chosen[path_named(name)] = setting_value(name, value)
    result: SegmentationConfig = updated(config, **nested(chosen))
    return result
