"""Recordings as the app Record3D writes them, made of scenes: color has twice as many pixels as depth."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from recorded_scene import CAMERA, HEIGHT, WIDTH, scenes

from nurbseg.common.frame import Calibration, RGBDFrame

CALIBRATION = Calibration(CAMERA, CAMERA.scaled_to(2 * WIDTH, 2 * HEIGHT))
#: A phone that is turned by a quarter about its viewing axis, and moves along x.
POSES = [[0.0, 0.0, 0.5**0.5, 0.5**0.5, 0.1 * index, 2.0, 3.0] for index in range(100)]


def table(frames: int, **other: Any) -> dict[str, Any]:
    """Return the metadata; those that are None are left out."""
    camera = CALIBRATION.color
    stated = {
        "w": camera.width,
        "h": camera.height,
        "dw": WIDTH,
        "dh": HEIGHT,
        "fps": 30,
        "K": [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1],
        "poses": POSES[:frames],
        "initPose": POSES[0],
        "cameraType": 1,
    }
    return {key: value for key, value in (stated | other).items() if value is not None}


def contents(frames: list[RGBDFrame]) -> dict[str, bytes]:
    """Return the files of the archive, the metadata apart."""
    import lzfse

    files = {"icon": b"", "sound.m4a": b""}
    for number, frame in enumerate(frames):
        depth_m = np.where(frame.depth_mm > 0, frame.depth_mm / 1000, np.nan).astype("<f4")
        files[f"rgbd/{number}.depth"] = lzfse.compress(depth_m.tobytes())
        files[f"rgbd/{number}.conf"] = lzfse.compress(bytes(WIDTH * HEIGHT))
        files[f"rgbd/{number}.jpg"] = cv2.imencode(".jpg", frame.color[..., ::-1])[1].tobytes()
    return files


def write_zip(path: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    """Write an archive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in files.items():
            file.writestr(name, content)
    return path


def write_r3d(path: Path, frames: int = 5, **other: Any) -> Path:
    """Write a recording of the first scenes; `other` are metadata."""
    stated = json.dumps(table(frames, **other)).encode()
    made = scenes(frames, CALIBRATION, labels=False)
    return write_zip(path, {"metadata": stated, **contents(made)})
