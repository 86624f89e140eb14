"""The renderer beside the demo recording, for benchmarks: it is not installed with the program."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent.parent / "recordings"))

from make_demo import make_demo
from scene.source import SyntheticOptions, SyntheticSource

__all__ = ["SyntheticOptions", "SyntheticSource", "recorded"]


def recorded(scene: str, folder: Path) -> Path:
    """Record the scene with options, ``frames=600&seed=1``, without loss; return the file."""
    path = folder / f"{scene.replace('=', '').replace('&', '-')}.mcap"
    make_demo(path, SyntheticOptions.from_text(scene), "png")
    return path
