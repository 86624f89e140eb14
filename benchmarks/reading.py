"""How many frames are read per second, by format and size: python benchmarks/reading.py [FRAMES].

Needs rosbags for .bag.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "fakes"))

from database_bag import to_database
from ros1_bag import to_ros1

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.drivers import open_source
from nurbseg.drivers.mcap.writer import RecordingWriter

_SIZES = ((640, 480), (1280, 720))


def made(width: int, height: int, index: int) -> RGBDFrame:
    """Return a frame with the noise of a camera, which compresses as badly."""
    rng = np.random.default_rng(index)
    rows, columns = np.mgrid[:height, :width]
    depth = 1000 + columns + 2 * rows + rng.integers(0, 8, (height, width))
    color = np.stack([columns % 256, rows % 256, rng.integers(0, 32, (height, width))], axis=-1)
    camera = Intrinsics(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2)
    return RGBDFrame(
        index,
        index * 33_333_333 + 1_700_000_000_000_000_000,
        depth.astype(np.uint16),
        color.astype(np.uint8),
        Calibration.registered(camera),
    )


def rate(path: Path) -> float:
    """Return the frames read per second, the first one and opening not counted."""
    with open_source(path) as source:
        source.read()
        begun_s = time.perf_counter()
        count = sum(1 for _ in source)
        return count / (time.perf_counter() - begun_s)


def main(frames: int) -> None:
    """Print a table."""
    print("| format | " + " | ".join(f"{width}x{height}" for width, height in _SIZES) + " |")
    print("|---|" + "---|" * len(_SIZES))
    rows: dict[str, list[str]] = {}
    for width, height in _SIZES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            mcap, frames_made = folder / "a.mcap", [made(width, height, index) for index in range(frames)]
            with RecordingWriter(mcap, frames_made[0].calibration) as writer:
                for frame in frames_made:
                    writer.write(frame)
            for form, path in (
                (".mcap, JPEG color", mcap),
                (".db3, the same messages", to_database(mcap, folder / "a.db3")),
                (".bag, the same messages", to_ros1(mcap, folder / "a.bag")),
            ):
                rows.setdefault(form, []).append(f"{rate(path):.0f}/s")
    for form, rates in rows.items():
        print(f"| {form} | " + " | ".join(rates) + " |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 90)
