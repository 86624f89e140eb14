"""Settings of the segmentation by their names or symbols, with values from texts."""

from typing import Any

from nurbseg.common.settings import nested, setting_paths, updated, value_kind
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
    for path, each in setting_paths(SegmentationConfig):
        if wanted in (path, each.name, each.metadata["symbol"]):
            return path
    known = ", ".join(each.name for _, each in setting_paths(SegmentationConfig))
    raise ValueError(f"{name}: no such setting; available: {known}")
