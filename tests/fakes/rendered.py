"""Recordings of the rendered scene, each made when it is first asked for and removed at the end."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from make_demo import make_demo
from scene.source import SyntheticOptions

_FOLDER = tempfile.TemporaryDirectory(prefix="nurbseg-scene-")


@cache
def rendered(scene: str) -> str:
    """Return the path of a recording of the scene with options, ``frames=3&width=96&height=72``."""
    path = Path(_FOLDER.name) / f"{scene.replace('=', '').replace('&', '-')}.mcap"
    make_demo(path, SyntheticOptions.from_text(scene), "png")
    return str(path)
