"""The values a depth camera delivers: intrinsics, calibration and frames."""

import time
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.depth import millimeters_by_type
from nurbseg.common.errors import in_utf8

#: Coefficients that OpenCV's distortion model accepts (k1, k2, p1, p2[, k3[, k4, k5, k6[, ...]]]).
_DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
#: The shortest focal length, as a share of the image's longer side: shorter ones are in another unit. The
#: farthest principal point, pixels.
_FOCAL_MIN, _PLACE_PX_MAX = 0.02, 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """A pinhole camera with lens distortion.

    Parameters
    ----------
    width, height : int
        Image size, pixels.
    fx, fy : float
        Focal lengths, pixels; `fy` is negative where a renderer's image runs upward.
    cx, cy : float
        Principal point, pixels.
    distortion : (K,) float64, optional
        OpenCV's coefficients (k1, k2, p1, p2, k3, ...), dimensionless; empty for a perfect lens.

    Raises
    ------
    ValueError
        If a value is not finite, a focal length is 0 or the size is no positive whole number.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"{name}: expected a positive number of pixels, got {value}")
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not isinstance(value, int | float | np.number) or not np.isfinite(value):
                raise ValueError(f"{name}: expected a finite number of pixels, got {value}")
        least = _FOCAL_MIN * max(self.width, self.height)
        if self.fx <= 0 or not all(least <= abs(f) <= _PLACE_PX_MAX for f in (self.fx, self.fy)):
            size = f"{self.width}x{self.height}"
            raise ValueError(f"fx, fy: expected focal lengths in pixels of {size}, got {self.fx}, {self.fy}")
        if max(abs(self.cx), abs(self.cy)) > _PLACE_PX_MAX:
            raise ValueError(f"cx, cy: expected a place in the image, got {self.cx}, {self.cy}")
        distortion = np.array(self.distortion, dtype=np.float64).ravel()
        if not distortion.any():
            # Whatever model they are of, and as many as it has.
            distortion = np.zeros(0)
        if distortion.size not in _DISTORTION_LENGTHS:
            raise ValueError(
                f"distortion: expected {_DISTORTION_LENGTHS} coefficients, got {distortion.size}"
            )
        if not np.isfinite(distortion).all():
            raise ValueError(f"distortion: expected finite coefficients, got {distortion.tolist()}")
        distortion.flags.writeable = False
        object.__setattr__(self, "distortion", distortion)
        # A few pixels all over the image will do.
        if np.isnan(self.rays(step=max(1, max(self.width, self.height) // 24))).mean() > 0.5:
            raise ValueError(
                f"distortion: expected rays for most pixels of a {self.width}x{self.height} image, got none "
                f"with {distortion.tolist()}"
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The (3, 3) camera matrix, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def rays(self, step: int = 1) -> NDArray[np.float32]:
        """Return the ray of each pixel, (H, W, 2) float32 of x / z and y / z, lens distortion removed.

        NaN where the distortion cannot be undone, as at the far corners of a strongly distorting lens. With a
        `step`, of every so many rows and columns only.
        """
        v, u = np.mgrid[: self.height : step, : self.width : step]
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        rays = np.stack([x, y], axis=-1)
        if self.distortion.any():
            from nurbseg.common.lens import undistort  # late: most cameras bring rectified images

            tolerance = 1e-3 / max(self.fx, abs(self.fy))
            rays = undistort(rays.reshape(-1, 2), self.distortion, tolerance).reshape(rays.shape)
        return rays.astype(np.float32)

    def equals(self, other: Self) -> bool:
        """Whether the other camera has the same values."""
        own, its = ((each.width, each.height, each.fx, each.fy, each.cx, each.cy) for each in (self, other))
        return own == its and np.array_equal(self.distortion, other.distortion)

    def scaled_to(self, width: int, height: int) -> Self:
        """Return the same camera for an image of another size, pixel centers being at integers."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )


def rigid(name: str, values: Any) -> NDArray[np.float64]:
    """Return a read-only copy of a rigid (4, 4) transform; raises ValueError if it is none."""
    transform = np.array(values, dtype=np.float64)
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise ValueError(f"{name}: expected a finite (4, 4) transform, got {transform.tolist()}")
    rotation = transform[:3, :3]
    is_rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not is_rigid or not np.allclose(transform[3], [0, 0, 0, 1]):
        raise ValueError(f"{name}: expected a rigid transform, got {transform.tolist()}")
    transform.flags.writeable = False
    return transform


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Both cameras of an RGB-D sensor and the rigid transform between them.

    Parameters
    ----------
    depth, color : Intrinsics
        The two cameras.
    color_from_depth : (4, 4) float64
        Takes points of the depth camera's frame to the color camera's; translation in meters.
        The identity where the depth image is registered to the color image already.

    Raises
    ------
    ValueError
        If `color_from_depth` is not a rigid transform.
    """

    depth: Intrinsics
    color: Intrinsics
    color_from_depth: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        object.__setattr__(self, "color_from_depth", rigid("color_from_depth", self.color_from_depth))

    @classmethod
    def registered(cls, camera: Intrinsics) -> Self:
        """Return the calibration of frames whose depth is registered to color: one camera for both."""
        return cls(depth=camera, color=camera)

    @property
    def is_registered(self) -> bool:
        """Whether a depth pixel and the color pixel at the same place show the same point."""
        return self.depth.equals(self.color) and np.array_equal(self.color_from_depth, np.eye(4))

    def equals(self, other: Self) -> bool:
        """Whether the other calibration has the same values."""
        return (
            self.depth.equals(other.depth)
            and self.color.equals(other.color)
            and np.array_equal(self.color_from_depth, other.color_from_depth)
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RGBDFrame:
    """A depth image and its color image, taken together.

    The arrays are made read-only, so that one frame can be shared between threads without a copy.

    Parameters
    ----------
    index : int
        Number of the frame in its source, from 0.
    timestamp_ns : int
        Device clock, nanoseconds.
    depth_mm : (H, W) uint16
        Depth image, millimeters; 0 where there is no depth.
    color : (Hc, Wc, 3) uint8
        Color image, RGB.
    calibration : Calibration
        Of the two cameras, for images of these sizes.
    labels : (H, W) uint16 or None
        Ground truth on the depth image's grid, 0 where there is none.
    name : str
        What a person calls the frame (a file's stem); may be empty.
    world_from_camera : (4, 4) float64 or None
        Takes points of the depth camera's frame to those of a world that does not move, translation in
        meters; None where the source does not know it.
    gravity : (3,) float64 or None
        The direction in which things fall, a unit vector of the depth camera's frame; None where the source
        does not know it.
    arrived_s : float or None
        When it arrived at this computer, by `time.monotonic`; None if it was not captured just now.
    jumps : int
        Seeks before it in a replay; where this changes, a frame does not continue the one before.

    Raises
    ------
    ValueError
        If a shape or dtype is wrong, an image does not have its camera's size, `world_from_camera` is no
        rigid transform or `gravity` no direction.
    """

    index: int
    timestamp_ns: int
    depth_mm: NDArray[np.uint16]
    color: NDArray[np.uint8]
    calibration: Calibration
    labels: NDArray[np.uint16] | None = None
    name: str = ""
    world_from_camera: NDArray[np.float64] | None = None
    gravity: NDArray[np.float64] | None = None
    arrived_s: float | None = None
    jumps: int = 0

    @property
    def age_s(self) -> float | None:
        """Time since it arrived at this computer, seconds; None if it was not captured just now."""
        return None if self.arrived_s is None else time.monotonic() - self.arrived_s

    def __repr__(self) -> str:
        height, width = self.depth_mm.shape
        name = f", {self.name!r}" if self.name else ""
        return f"RGBDFrame({self.index}{name}, {width}x{height}, {self.timestamp_ns} ns)"

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", in_utf8(self.name))
        if not isinstance(self.timestamp_ns, int | np.integer):
            raise ValueError(f"timestamp_ns: expected whole nanoseconds, got {self.timestamp_ns!r}")
        for name, image, camera, expected, ndim, dtype in (
            ("depth_mm", self.depth_mm, self.calibration.depth, "(H, W) uint16", 2, np.uint16),
            ("color", self.color, self.calibration.color, "(H, W, 3) uint8", 3, np.uint8),
        ):
            if not isinstance(image, np.ndarray):
                raise ValueError(f"{name}: expected {expected}, got {type(image).__name__}")
            if image.ndim != ndim or image.shape[2:] not in ((), (3,)) or image.dtype != dtype:
                raise ValueError(f"{name}: expected {expected}, got {image.shape} {image.dtype}")
            if image.shape[:2] != (camera.height, camera.width):
                size = f"{camera.width}x{camera.height}"
                got = f"{image.shape[1]}x{image.shape[0]}"
                raise ValueError(f"{name}: expected {size} as calibrated, got {got}")
        if self.labels is not None:
            if self.labels.shape != self.depth_mm.shape or self.labels.dtype != np.uint16:
                got = f"{self.labels.shape} {self.labels.dtype}"
                raise ValueError(f"labels: expected {self.depth_mm.shape} uint16, got {got}")
            self.labels.flags.writeable = False
        if self.world_from_camera is not None:
            pose = rigid("world_from_camera", self.world_from_camera)
            object.__setattr__(self, "world_from_camera", pose)
        if self.gravity is not None:
            object.__setattr__(self, "gravity", _direction("gravity", self.gravity))
        self.depth_mm.flags.writeable = False
        self.color.flags.writeable = False

    @classmethod
    def from_arrays(
        cls,
        depth: NDArray[Any],
        color: NDArray[Any],
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        *,
        index: int = 0,
        timestamp_ns: int = 0,
        name: str = "",
    ) -> Self:
        """Return the frame of a depth image that is registered to its color image; both are copied.

        Parameters
        ----------
        depth : (H, W) uint16 or float
            Millimeters if whole numbers, meters if floating point; 0, NaN, 65535 or masked where there is no
            depth.
        color : (H, W, 3) uint8
            RGB. What OpenCV reads is BGR: ``color[..., ::-1]``.
        fx, fy, cx, cy : float
            Focal lengths and principal point, pixels.
        index, timestamp_ns, name : int, int, str
            As of a frame.

        Raises
        ------
        ValueError
            If a shape, dtype or value is wrong, or the images differ in size.

        Warns
        -----
        UserWarning
            If floating-point depth is 200 or more everywhere: it is probably in millimeters.
        """
        depth, color = _as_array("depth", depth), _as_array("color", color)
        if depth.ndim != 2 or depth.shape != color.shape[:2]:
            raise ValueError(
                f"depth, color: expected (H, W) and (H, W, 3) of the same size, got {depth.shape} and "
                f"{color.shape}; those of two cameras need RGBDFrame(..., calibration=Calibration(...))"
            )
        depth_mm = millimeters_by_type(depth)
        camera = Intrinsics(depth.shape[1], depth.shape[0], fx, fy, cx, cy)
        return cls(index, timestamp_ns, depth_mm, color, Calibration.registered(camera), name=name)


def _direction(name: str, values: Any) -> NDArray[np.float64]:
    """Return a read-only (3,) vector of length 1; raises ValueError if it has no direction."""
    vector = np.array(values, dtype=np.float64)
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not 0 < length < np.inf:
        raise ValueError(f"{name}: expected a finite (3,) vector, got {vector.tolist()}")
    vector /= length
    vector.flags.writeable = False
    return vector


def _as_array(name: str, values: Any) -> NDArray[Any]:
    """Return a copy of array-like values in this computer's byte order, 0 where they are masked."""
    if isinstance(values, np.ma.MaskedArray):
        values = values.filled(0)
    try:
        array = np.array(values, order="C")
    # Whatever the library that they come from raises: PyTorch a TypeError for those of a GPU.
    except Exception as err:
        raise ValueError(f"{name}: cannot be made a NumPy array ({err})") from err
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def check_frame(frame: object) -> None:
    """Raise TypeError if something is no `RGBDFrame`, such as an array."""
    if not isinstance(frame, RGBDFrame):
        how = "RGBDFrame.from_arrays(depth, color, fx, fy, cx, cy)"
        raise TypeError(f"frame: expected an RGBDFrame, such as {how}, got {type(frame).__name__}")
