"""Point clouds of a depth camera as depth and color images: PCD files, one or a folder of them."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, FrameFormatError
from nurbseg.common.files import with_suffix
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.drivers.datasets.images import GRAY
from nurbseg.drivers.datasets.pcd_file import read_pcd
from nurbseg.drivers.datasets.sequence import SequenceSource, natural_key
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

_log = logging.getLogger(__name__)

#: The scatter about a pinhole camera's rays, root mean square, that rounding and a lens may cause: as a part
#: of the width, and pixels.
_RESIDUAL_MAX, _RESIDUAL_MAX_PX = 1 / 320, 0.5
#: Scatter as a part of the width from which on points may be turned, as by a third of a degree; and how much
#: of it a turn leaves. Of a lens' distortion it leaves a third or more, and of noise nearly all.
_TURNED_MIN, _TURNED_LEFT = 5e-4, 0.25
#: Points that a camera is found from at most.
_FITTED_MAX = 65_536
#: Points from which on a camera is found.
POINTS_FOR_FIT = 100
#: Camera's axes (x right, y down, z forward) in themselves, in those of a body (x forward, y left, z up), and
#: of OpenGL (x right, y up, z backward).
_AXES = (
    np.eye(3, dtype=np.float32),
    np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float32),
    np.diag([1, -1, -1]).astype(np.float32),
)
#: Rows and columns from one point to the next of those that tell the axes, unless these are fewer.
_SPARSE, _ENOUGH_TO_TELL = 4, 400


def fit_camera(points_m: NDArray[np.float32], name: str) -> Intrinsics:
    """Find the pinhole camera on whose pixel grid an organized cloud lies.

    Least squares of ``u = fx x / z + cx`` and ``v = fy y / z + cy``, which is exact for clouds made from
    depth images.

    Parameters
    ----------
    points_m : (H, W, 3) float32
        Meters, NaN where there is no point.
    name : str
        What an error calls the cloud.

    Raises
    ------
    CalibrationError
        If there are too few points, or they do not lie on a camera's rays.
    """
    height, width = points_m.shape[:2]
    some = np.flatnonzero(points_m[..., 2] > 0)
    v, u = np.divmod(some[:: len(some) // _FITTED_MAX + 1], width)
    if len(v) < POINTS_FOR_FIT or np.ptp(u) < 2 or np.ptp(v) < 2:
        raise CalibrationError(
            f"{name}: x, y, z: {len(v)} points with z > 0 are too few to find the camera; "
            "give --intrinsics fx,fy,cx,cy"
        )
    p = points_m[v, u].astype(np.float64)
    rays = p / p[:, 2:]
    found = []
    residuals = []
    for axis, pixel, slope in (("x", u, rays[:, 0]), ("y", v, rays[:, 1])):
        A = np.stack([slope, np.ones_like(slope)], axis=1)
        solution = np.linalg.lstsq(A, pixel, rcond=None)[0]
        residuals.append(float(np.sqrt(np.mean((A @ solution - pixel) ** 2))))
        if residuals[-1] > max(_RESIDUAL_MAX_PX, _RESIDUAL_MAX * width):
            raise CalibrationError(
                f"{name}: {axis}: the points do not lie on a pinhole camera's rays "
                f"({residuals[-1]:.1f} pixels off); if z is depth, give --intrinsics fx,fy,cx,cy"
            )
        found.append(solution)
    is_wide = np.ptp(u) >= width / 2 and np.ptp(v) >= height / 2
    scatter = float(np.linalg.norm(residuals))
    if is_wide and scatter > _TURNED_MIN * width and _left_by_a_turn(rays, u, v) < _TURNED_LEFT * scatter:
        raise CalibrationError(
            f"{name}: x, y, z: the points are turned against their camera's axes, so that z is not depth "
            f"({scatter:.1f} pixels off, but for a turn); save them in the camera's own frame"
        )
    (fx, cx), (fy, cy) = found
    try:
        return Intrinsics(width=width, height=height, fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy))
    except ValueError as err:
        raise CalibrationError(f"{name}: {err}") from err


def _left_by_a_turn(rays: NDArray[np.float64], u: NDArray[np.intp], v: NDArray[np.intp]) -> float:
    """Return the scatter, pixels, about the homography from (N, 3) rays to pixels, which has any turn."""
    pixels = np.stack([u, v]) - np.array([[u.mean()], [v.mean()]])
    none = np.zeros_like(rays)
    A = np.vstack(
        [
            np.hstack([*sides, -pixel[:, None] * rays[:, :2]])
            for sides, pixel in zip(((rays, none), (none, rays)), pixels, strict=True)
        ]
    )
    solution = np.linalg.lstsq(A, pixels.ravel(), rcond=None)[0]
    mapped = rays @ np.append(solution, 1.0).reshape(3, 3).T
    return float(np.sqrt(np.mean((mapped[:, :2] / mapped[:, 2:] - pixels.T) ** 2) * 2))


def in_camera_axes(points_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an organized cloud in its camera's axes.

    The drivers of ZED and Gazebo state clouds in the axes of a body [1]_, viewers in those of OpenGL. Only in
    the camera's do points lie on the rays of pixels. A cloud that is in none of these stays as it is; of
    points too few to tell, none is left.

    Parameters
    ----------
    points_m : (H, W, 3) float32
        Meters, NaN where there is no point.

    Returns
    -------
    (H, W, 3) float32
        The points, x right, y down and z forward.

    References
    ----------
    .. [1] ROS REP 103, https://www.ros.org/reps/rep-0103.html
    """
    some = points_m[::_SPARSE, ::_SPARSE]
    if count_points(some) < _ENOUGH_TO_TELL:
        some = points_m
    if count_points(some) < POINTS_FOR_FIT:
        return np.full_like(points_m, np.nan)
    for axes in _AXES:
        if _lie_on_rays(some @ axes):
            return points_m if axes is _AXES[0] else points_m @ axes
    return points_m


def count_points(points_m: NDArray[np.float32]) -> int:
    """Count the points of an (H, W, 3) cloud: neither NaN nor in the camera itself."""
    return int(np.count_nonzero(np.abs(points_m).sum(axis=-1) > 0))


def _lie_on_rays(points_m: NDArray[np.float32]) -> bool:
    try:
        fit_camera(points_m, "")
    except CalibrationError:
        return False
    return True


class PcdSource(SequenceSource):
    """Replays PCD files of organized clouds, 1/30 s apart; depth is z, color is gray where there is none.

    `path` is one file, or a folder of files, which are played in the natural order of their names. Where
    `options` have neither calibration nor intrinsics, they are found from the points. Raises
    RecordingFormatError if no file can be used, and CalibrationError if the camera cannot be found.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self._paths, self._options = [path], options
        if path.is_dir():
            self._paths = sorted(with_suffix(path, ".pcd"), key=lambda file: natural_key(file.name))
        super().__init__(path, len(self._paths), "PCD, organized")
        convention = DepthUnit(1.0, "clouds are in meters")
        self._unit = self._state_depth_unit(decided_unit(options.depth_scale, None, convention))
        first = self._first()
        self.calibration = first.calibration
        if (first.color == GRAY).all():
            _log.warning("%s: the points have no color that can be read; the color is gray", path)

    def _load(self, index: int) -> RGBDFrame:
        path = self._paths[index]
        cloud = read_pcd(path)
        points_m = in_camera_axes(cloud.points_m)
        height, width = points_m.shape[:2]
        color = np.full((height, width, 3), GRAY, np.uint8) if cloud.color is None else cloud.color
        try:
            calibration = self._calibration(points_m, path)
        except CalibrationError as err:
            raise FrameFormatError(str(err)) from err
        return RGBDFrame(
            index=index,
            timestamp_ns=index * FRAME_INTERVAL_NS,
            depth_mm=self._unit.millimeters(points_m[..., 2]),
            color=color,
            calibration=calibration,
            name=path.stem,
        )

    def _calibration(self, points_m: NDArray[np.float32], path: Path) -> Calibration:
        size = (points_m.shape[1], points_m.shape[0])
        given = self._options.given_cameras()
        if given is not None:
            # A cloud's colors are on its own grid, whichever camera took them.
            return Calibration.registered(given.depth.of_size(size).intrinsics(size))
        return Calibration.registered(fit_camera(points_m, str(path)))
