"""Wires, threads and shows: the commands."""

from __future__ import annotations

#: Importing `typing` for it takes a third of the time in which Ctrl-C is Python's alone.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from nurbseg.app.command.config import AppConfig
    from nurbseg.app.live.capture import Captured, CaptureThread
    from nurbseg.app.live.tracking import process_frame
    from nurbseg.app.result import FrameResult
    from nurbseg.app.view.view import View, open_view

__all__ = [
    "AppConfig",
    "CaptureThread",
    "Captured",
    "FrameResult",
    "View",
    "open_view",
    "process_frame",
]

_MODULES = {
    "AppConfig": "command.config",
    "CaptureThread": "live.capture",
    "Captured": "live.capture",
    "FrameResult": "result",
    "View": "view.view",
    "open_view": "view.view",
    "process_frame": "live.tracking",
}


def __getattr__(name: str) -> Any:
    # Late, so that a command's --help need not wait for numpy and OpenCV.
    from importlib import import_module

    if name in _MODULES:
        return getattr(import_module(f"nurbseg.app.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
