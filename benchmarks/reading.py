"""How many frames are read per second, by format and size: python benchmarks/reading.py [FRAMES].

Needs rosbags for .bag and lzfse for .r3d. In .r3d depth has 256 columns whatever color has, as a LiDAR's; in
.mkv the images have modes of an Azure Kinect: depth of 640x576 or 1024x1024, color of 1280x720.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "fakes"))

import cv2
import lzfse
from database_bag import to_database
from kinect_file import kinect_frames, write_mkv
from record3d_file import table, write_zip
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


def to_r3d(path: Path, frames: list[RGBDFrame]) -> Path:
    """Write frames as Record3D does, their depth at 256x192."""
    camera = frames[0].calibration.color
    matrix = [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1]
    height = camera.height * 256 // camera.width
    stated = table(len(frames), w=camera.width, h=camera.height, dw=256, dh=height, K=matrix)
    files = {"metadata": json.dumps(stated).encode()}
    for frame in frames:
        depth_m = cv2.resize(frame.depth_mm, (256, height), interpolation=cv2.INTER_NEAREST) / 1000
        files[f"rgbd/{frame.index}.depth"] = lzfse.compress(depth_m.astype("<f4").tobytes())
        jpeg = cv2.imencode(".jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
        files[f"rgbd/{frame.index}.jpg"] = jpeg.tobytes()
    return write_zip(path, files)


def to_mkv(path: Path, side: tuple[int, int], frames: int) -> Path:
    """Write a recording of k4arecorder with depth of this size."""
    rng = np.random.default_rng(0)
    made = kinect_frames(frames, side, (1280, 720))
    noisy = [each.depth_mm + rng.integers(0, 8, each.depth_mm.shape).astype(np.uint16) for each in made]
    return write_mkv(path, [replace(each, depth_mm=depth) for each, depth in zip(made, noisy, strict=True)])


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
            side = (640, 576) if width == 640 else (1024, 1024)
            for form, path in (
                (".mcap, JPEG color", mcap),
                (".db3, the same messages", to_database(mcap, folder / "a.db3")),
                (".bag, the same messages", to_ros1(mcap, folder / "a.bag")),
                (".r3d", to_r3d(folder / "a.r3d", frames_made)),
                (".mkv, MJPEG color", to_mkv(folder / "a.mkv", side, frames)),
            ):
                rows.setdefault(form, []).append(f"{rate(path):.0f}/s")
    for form, rates in rows.items():
        print(f"| {form} | " + " | ".join(rates) + " |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 90)
