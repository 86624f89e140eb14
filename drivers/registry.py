"""Opens a source of frames from what a user names: a URI or a path."""

from __future__ import annotations

from dataclasses import dataclass

from nurbseg.drivers.frame import Intrinsics
from nurbseg.drivers.source import FrameSource


@dataclass(frozen=True, slots=True, eq=False)
class SourceOptions:
    """What a user may add to a URI or path.

    Parameters
    ----------
    intrinsics : tuple of float or None
        ``(fx, fy, cx, cy)`` in pixels of the registered images, for recordings that bring none.
    depth_scale : float or None
        Depth units per metre of a recording that does not say it; None takes the format's own.
    association_limit_s : float
        Largest difference between the stamps of a depth image and its color image, seconds.
    """

    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float | None = None
    association_limit_s: float = 0.02


def open_source(uri: str, options: SourceOptions | None = None) -> FrameSource:
    """Open a camera, a recording or the synthetic scene."""
    raise NotImplementedError


__all__ = ["Intrinsics", "SourceOptions", "open_source"]
