"""Small labeled frames: a box before a wall, at another place in each frame."""

from pathlib import Path

import cv2
import numpy as np
import pytest


def write_frames(folder: Path, count: int, *, size: tuple[int, int] = (96, 72)) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    width, height = size
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[:height, :width]
    for number in range(count):
        left, top = 10 + 4 * number, 15 + number
        box = (columns >= left) & (columns < left + 40) & (rows >= top) & (rows < top + 35)
        depth = np.where(box, 900, 1500 + 2 * rows) + rng.integers(-2, 3, (height, width))
        color = np.where(box[:, :, None], (40, 60, 200), (180, 170, 160)) + rng.integers(
            -8, 9, (*box.shape, 3)
        )
        stem = folder / f"learn{number}"
        cv2.imwrite(f"{stem}_color.png", color.astype(np.uint8))
        cv2.imwrite(f"{stem}_depth.png", depth.astype(np.uint16))
        cv2.imwrite(f"{stem}_label.png", np.where(box, 20, 1).astype(np.uint8))
    (folder / "intrinsics.txt").write_text("80 0 47.5\n0 80 35.5\n0 0 1\n")
    return folder


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    return write_frames(tmp_path / "frames", 5)


@pytest.fixture(scope="session")
def lasting_frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same frames, for tests that change none of them."""
    return write_frames(tmp_path_factory.mktemp("lasting") / "frames", 5)
