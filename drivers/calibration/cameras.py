"""The two cameras of a calibration file, before the images' sizes are known."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.errors import CalibrationError, quoted
from nurbseg.drivers.frame import Calibration, Intrinsics
from nurbseg.drivers.limits import PIXELS_MAX


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """One camera of a calibration file; `path` and `field` say where it was read, for messages.

    The (3, 3) camera matrix is in pixels of an image of `size`, (width, height), which is None where the file
    does not say. The distortion has OpenCV's coefficients. Raises CalibrationError if the matrix is not a
    camera's.
    """

    path: Path
    field: str
    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.zeros(0))
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        where = f"{self.path}: {self.field}: expected"
        if not self.matrix.any():
            raise CalibrationError(f"{self.path}: {self.field}: the camera is not calibrated (all zeros)")
        if not np.isfinite(self.matrix).all():
            raise CalibrationError(f"{where} finite numbers, got {quoted(self.matrix.tolist())}")
        if not np.allclose(self.matrix[2], [0, 0, 1]):
            raise CalibrationError(f"{where} the last row 0 0 1, got {self.matrix[2].tolist()}")

    def intrinsics(self, size: tuple[int, int] | None, base: tuple[int, int] | None = None) -> Intrinsics:
        """Return the camera of images of `size`; `base` is its own size where the file does not say.

        Raises CalibrationError if no size is known, the shapes differ or a value is unusable.
        """
        own = self.size or base or size
        if own is None:
            raise CalibrationError(f"{self.path}: {self.field}: width and height are missing")
        size = size or own
        if own[0] * size[1] != own[1] * size[0]:
            raise CalibrationError(
                f"{self.path}: {self.field}: the camera of {own[0]}x{own[1]} images does not match images "
                f"of another aspect ratio, {size[0]}x{size[1]}"
            )
        try:
            (fx, _, cx), (_, fy, cy), _ = self.matrix.tolist()
            camera = Intrinsics(*own, fx, fy, cx, cy, self.distortion)
            return camera if size == own else camera.scaled_to(*size)
        except ValueError as err:
            raise CalibrationError(f"{self.path}: {self.field}: {err}") from err


@dataclass(frozen=True, slots=True, eq=False)
class CameraFile:
    """A calibration file's two cameras, their transform and the depth images' scale.

    The cameras are one and the same where the images are registered. The translation of `color_from_depth`
    (4, 4) is in metres; `depth_scale` is in units per metre, where the file says so.
    """

    path: Path
    depth: CameraModel
    color: CameraModel
    color_from_depth: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.eye(4))
    depth_scale: float | None = None

    @classmethod
    def of_calibration(cls, calibration: Calibration, path: Path) -> CameraFile:
        """Return a known calibration as if it had been read from `path`."""
        depth, color = (
            CameraModel(path, name, each.matrix, each.distortion, (each.width, each.height))
            for name, each in (("depth", calibration.depth), ("color", calibration.color))
        )
        color = depth if calibration.is_registered else color
        return cls(path=path, depth=depth, color=color, color_from_depth=calibration.color_from_depth)

    @classmethod
    def of_intrinsics(cls, values: tuple[float, float, float, float]) -> CameraFile:
        """Return the camera of registered images from the user's fx, fy, cx, cy (pixels)."""
        fx, fy, cx, cy = values
        # Named after the flag, which is what the user can correct.
        path = Path("--intrinsics")
        camera = CameraModel(path, "fx,fy,cx,cy", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64))
        return cls(path=path, depth=camera, color=camera)

    def calibration(
        self, *, depth_size: tuple[int, int] | None = None, color_size: tuple[int, int] | None = None
    ) -> Calibration:
        """Return the calibration for images of these sizes (width, height).

        Intrinsics are scaled to another size of the same shape. One camera without a size, standing for both,
        is that of the depth images. Raises CalibrationError if a size is missing, a shape does not fit or a
        value is unusable.
        """
        base = depth_size if self.color is self.depth else None
        depth = self.depth.intrinsics(depth_size)
        color = self.color.intrinsics(color_size, base)
        try:
            return Calibration(depth=depth, color=color, color_from_depth=self.color_from_depth)
        except ValueError as err:
            raise CalibrationError(f"{self.path}: {err}") from err


def calibration_table(calibration: Calibration) -> dict[str, Any]:
    """Return a calibration as TOML files and the notes of .oni recordings hold it."""

    def camera(each: Intrinsics) -> dict[str, Any]:
        focal_and_center = {name: float(getattr(each, name)) for name in ("fx", "fy", "cx", "cy")}
        size = {"width": int(each.width), "height": int(each.height)}
        return size | focal_and_center | {"distortion": each.distortion.tolist()}

    return {
        "depth": camera(calibration.depth),
        "color": camera(calibration.color),
        "color_from_depth": calibration.color_from_depth.tolist(),
    }


def number(path: Path, field: str, value: Any) -> float:
    """Return a finite number of a calibration file; raises CalibrationError if it is not one."""
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:
        # An integer of more than 308 digits.
        pass
    raise CalibrationError(f"{path}: {field}: expected a finite number, got {quoted(value)}")


def image_size(path: Path, fields: tuple[str, str], values: tuple[Any, Any]) -> tuple[int, int] | None:
    """Return the width and height in a calibration file; None if it has neither.

    Raises CalibrationError if they are not whole numbers of pixels, or too many.
    """
    if values == (None, None):
        return None
    for field, value in zip(fields, values, strict=True):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= PIXELS_MAX:
            raise CalibrationError(f"{path}: {field}: expected pixels, got {quoted(value)}")
        if value != int(value):
            raise CalibrationError(f"{path}: {field}: expected whole pixels, got {value}")
    width, height = int(values[0]), int(values[1])
    if width * height > PIXELS_MAX:
        raise CalibrationError(
            f"{path}: {', '.join(fields)}: expected {PIXELS_MAX} pixels at most in all, "
            f"got {width} x {height}"
        )
    return width, height
