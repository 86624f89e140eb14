"""The two cameras of a calibration file, before the images' sizes are known."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, quoted
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.common.limits import PIXELS_MAX
from nurbseg.drivers.depth_unit import DepthUnit

#: Names of OpenCV's distortion model; others, as "equidistant", are different models.
_DISTORTION_MODELS = (
    *("plumb_bob", "rational_polynomial", "thin_prism_fisheye", "radtan", "opencv", "full_opencv"),
    *("pinhole", "brown_conrady", "perspective"),
)
#: Names of its coefficients as a list, and what others that mean the same look like.
DISTORTIONS = ("distortion_coefficients", "d", "D", "dist_coeffs", "distCoeffs", "dist", "distortion")
_OF_DISTORTION = re.compile(r"dist(?!ance|ortion_model)|\w+_distortion$", re.IGNORECASE)
#: Models that are none of a pinhole camera, whatever their coefficients.
_OTHER_PROJECTIONS = ("equirectangular", "opencv_fisheye", "kannalabrandt8")
#: The cameras of one sensor are closer than this; a longer translation may be in millimeters.
_LONGEST_BASELINE_M = 1.0


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
        if max(abs(self.matrix[0, 1]), abs(self.matrix[1, 0])) > 1e-3 * abs(self.matrix[0, 0]):
            raise CalibrationError(f"{where} no skew, got {quoted(self.matrix[:2].tolist())}")

    def of_size(self, size: tuple[int, int] | None) -> CameraModel:
        """Return the camera as one of images of this size, if the file does not state another."""
        return self if self.size is not None or size is None else dataclasses.replace(self, size=size)

    def intrinsics(self, size: tuple[int, int] | None) -> Intrinsics:
        """Return the camera of images of `size`, or of its own.

        Raises CalibrationError if no size is known, the shapes differ, the principal point is outside the
        image or a value is unusable.
        """
        own = self.size or size
        if own is None:
            raise CalibrationError(f"{self.path}: {self.field}: width and height are missing")
        size = size or own
        cx, cy = self.matrix[:2, 2].tolist()
        if not (-0.5 <= cx <= own[0] - 0.5 and -0.5 <= cy <= own[1] - 0.5):
            raise CalibrationError(
                f"{self.path}: {self.field}: the principal point {cx:g}, {cy:g} is outside the image of "
                f"{own[0]}x{own[1]}; if the camera is that of images of another size, state their width and "
                "height in camera.toml, else correct it: in the middle it is "
                f"{(own[0] - 1) / 2:g}, {(own[1] - 1) / 2:g}"
            )
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
    """A calibration file's two cameras, their transform and the depth images' unit.

    The cameras are one and the same where the images are registered. The translation of `color_from_depth`
    (4, 4) is in meters; `depth_unit` is None where the file does not say it. Raises CalibrationError if the
    cameras are over 1 m apart.
    """

    path: Path
    depth: CameraModel
    color: CameraModel
    color_from_depth: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.eye(4))
    depth_unit: DepthUnit | None = None

    def __post_init__(self) -> None:
        place = self.color_from_depth[:3, 3]
        if np.linalg.norm(place) > _LONGEST_BASELINE_M:
            meters = ", ".join(f"{value:.6g}" for value in place / 1000)
            raise CalibrationError(
                f"{self.path}: the two cameras are {np.linalg.norm(place):.3g} m apart; expected "
                f"{_LONGEST_BASELINE_M:g} m at most: if that is in millimeters, write the translation in "
                f"meters: {meters}"
            )

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
        # Named after the flag, which is what the user can correct.
        path = Path("--intrinsics")
        camera = CameraModel(path, "fx,fy,cx,cy", pinhole_matrix(*values))
        return cls(path=path, depth=camera, color=camera)

    def calibration(
        self, *, depth_size: tuple[int, int] | None = None, color_size: tuple[int, int] | None = None
    ) -> Calibration:
        """Return the calibration for images of these sizes (width, height).

        Intrinsics are scaled to another size of the same shape. Sizes that the file leaves open are found as
        `with_sizes` does. Raises CalibrationError if a size is missing, a shape does not fit or a value is
        unusable.
        """
        own = self.with_sizes(depth_size, color_size)
        depth, color = own.depth.intrinsics(depth_size), own.color.intrinsics(color_size)
        try:
            return Calibration(depth=depth, color=color, color_from_depth=self.color_from_depth)
        except ValueError as err:
            raise CalibrationError(f"{self.path}: {err}") from err

    def with_sizes(
        self, depth_size: tuple[int, int] | None, color_size: tuple[int, int] | None
    ) -> CameraFile:
        """Return the same cameras, with these sizes where the file leaves them open.

        One camera that stands for both is that of the depth images.
        """
        is_one = self.color is self.depth
        depth = self.depth.of_size(depth_size or (color_size if is_one else None))
        color = depth if is_one else self.color.of_size(color_size)
        return dataclasses.replace(self, depth=depth, color=color)


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


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Return the (3, 3) camera matrix, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def check_distortion_model(path: Path, field: str, model: Any, coefficients: NDArray[np.float64]) -> None:
    """Raise CalibrationError if a lens model that is not OpenCV's distorts.

    Without coefficients, or with zeros only, every model is taken for none: drivers of cameras whose images
    are rectified name any.
    """
    plain = re.sub(r"[\W_]+", "_", str(model).casefold()).removeprefix("distortion_")
    if model and plain not in _DISTORTION_MODELS and (coefficients.any() or plain in _OTHER_PROJECTIONS):
        expected = ", ".join(_DISTORTION_MODELS)
        expected += "" if plain in _OTHER_PROJECTIONS else ", or coefficients of 0"
        raise CalibrationError(
            f"{path}: {field}: expected one of {expected}, got {quoted(model)} with "
            f"{quoted(coefficients.tolist())}"
        )


def is_distortion(path: Path, name: str) -> bool:
    """Whether values of this name are a lens's distortion; raises CalibrationError if the name is unknown."""
    if name not in DISTORTIONS and _OF_DISTORTION.match(name):
        raise CalibrationError(f"{path}: {quoted(name)}: unknown; expected one of {', '.join(DISTORTIONS)}")
    return name in DISTORTIONS


def number(path: Path, field: str, value: Any) -> float:
    """Return a finite number of a calibration file; raises CalibrationError if it is not one."""
    # An integer of more than 308 digits overflows.
    with contextlib.suppress(OverflowError):
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    raise CalibrationError(f"{path}: {field}: expected a finite number, got {quoted(value)}")


def image_size(path: Path, fields: tuple[str, str], values: tuple[Any, Any]) -> tuple[int, int] | None:
    """Return the width and height in a calibration file; None if it has neither.

    Raises CalibrationError if they are not whole numbers of pixels, or too many.
    """
    if values == (None, None):
        return None
    for field, value in zip(fields, values, strict=True):
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not 1 <= value <= PIXELS_MAX or value != int(value):
            raise CalibrationError(f"{path}: {field}: expected whole pixels, got {quoted(value)}")
    width, height = int(values[0]), int(values[1])
    if width * height > PIXELS_MAX:
        most = f"expected {PIXELS_MAX} pixels at most in all, got {width} x {height}"
        raise CalibrationError(f"{path}: {', '.join(fields)}: {most}")
    return width, height
