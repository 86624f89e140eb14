"""Frames with something to see in them, and recordings of them in every form that can be replayed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.drivers.calibration.file import write_calibration
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.options import ColorFormat

WIDTH, HEIGHT = 64, 48
CAMERA = Intrinsics(WIDTH, HEIGHT, 52.5, 52.5, 31.5, 23.5)
REGISTERED = Calibration.registered(CAMERA)
TURN = cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0]
APART = Calibration(
    depth=Intrinsics(WIDTH, HEIGHT, 57.6, 57.6, 31.5, 23.1, np.array([-0.05, 0.2, -0.01, -0.003, -1.0])),
    color=Intrinsics(80, 60, 68.0, 68.2, 39.0, 29.0, np.array([0.07, -0.03, -0.01, 0.0, -0.14])),
    color_from_depth=np.block([[TURN, np.array([[-0.025], [0.0006], [-0.0012]])], [np.zeros((1, 3)), 1.0]]),
)
INTERVAL_NS = 33_333_333


def scene(index: int, calibration: Calibration = REGISTERED, *, labels: bool = True) -> RGBDFrame:
    """Return a frame: a tilted floor, a ball that moves, holes, and colors that vary."""
    depth, color = calibration.depth, calibration.color
    v, u = np.mgrid[: depth.height, : depth.width]
    depth_mm = (1500 + 7 * u + 3 * v).astype(np.uint16)
    ball = (u - 20 - index) ** 2 + (v - 24) ** 2 < 100
    depth_mm[ball] = 900 + 11 * index
    depth_mm[(u + v) % 17 == 0] = 0
    rows, columns = np.mgrid[: color.height, : color.width]
    image = np.stack([4 * columns, 4 * rows, 2 * columns + 2 * rows], axis=-1) % 256
    image[5:15, 10 + index : 20 + index] = (200, 30, 60)
    return RGBDFrame(
        index=index,
        timestamp_ns=1_700_000_000_000_000_000 + index * INTERVAL_NS,
        depth_mm=depth_mm,
        color=image.astype(np.uint8),
        calibration=calibration,
        labels=np.where(ball, 2, 1).astype(np.uint16) if labels else None,
        name=f"scene{index}",
    )


def scenes(count: int, calibration: Calibration = REGISTERED, *, labels: bool = True) -> list[RGBDFrame]:
    """Return the first frames."""
    return [scene(index, calibration, labels=labels) for index in range(count)]


def write_image(path: Path, image: NDArray[np.generic]) -> None:
    """Write an image; color is RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = image[..., ::-1]
    assert cv2.imwrite(str(path), np.ascontiguousarray(image))


def write_mcap(path: Path, frames: list[RGBDFrame], color_format: ColorFormat = "png") -> Path:
    """Write our recording."""
    with RecordingWriter(
        path, frames[0].calibration, color_format=color_format, metadata={"name": "test"}
    ) as writer:
        for frame in frames:
            writer.write(frame)
    return path


def write_pairs(folder: Path, frames: list[RGBDFrame], *, calibration: bool = True) -> Path:
    """Write a folder of NAME_color.png, NAME_depth.png and NAME_label.png."""
    for frame in frames:
        write_image(folder / f"shot{frame.index}_color.png", frame.color)
        write_image(folder / f"shot{frame.index}_depth.png", frame.depth_mm)
        if frame.labels is not None:
            write_image(folder / f"shot{frame.index}_label.png", frame.labels)
    if calibration:
        write_calibration(folder / "camera.toml", frames[0].calibration)
    return folder


def write_opencv(path: Path, calibration: Calibration) -> Path:
    """Write a stereo calibration as OpenCV does."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, camera in (("depth", calibration.depth), ("color", calibration.color)):
        storage.write(f"{name}_width", camera.width)
        storage.write(f"{name}_height", camera.height)
        storage.write(f"{name}_camera_matrix", camera.matrix)
        if camera.distortion.size:
            storage.write(f"{name}_distortion", camera.distortion.reshape(1, -1))
    storage.write("R", np.ascontiguousarray(calibration.color_from_depth[:3, :3]))
    storage.write("T", np.ascontiguousarray(calibration.color_from_depth[:3, 3:]))
    storage.release()
    return path


def write_tum(folder: Path, frames: list[RGBDFrame]) -> Path:
    """Write a TUM RGB-D folder; depth has 5000 units per meter, and color is 4 ms late."""
    lines: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for frame in frames:
        units = (frame.depth_mm.astype(np.uint32) * 5).astype(np.uint16)
        for kind, image, late_ns in (("rgb", frame.color, 4_000_000), ("depth", units, 0)):
            stamp = f"{(frame.timestamp_ns + late_ns) / 1e9:.6f}"
            write_image(folder / kind / f"{stamp}.png", image)
            lines[kind].append(f"{stamp} {kind}/{stamp}.png")
    for kind, text in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(text) + "\n")
    write_calibration(folder / "camera.toml", frames[0].calibration)
    return folder
