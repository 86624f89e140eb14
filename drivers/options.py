"""What a user may specify besides a URI or path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nurbseg.common.frame import Calibration
    from nurbseg.drivers.calibration.cameras import CameraFile
    from nurbseg.drivers.live.device_options import DeviceOptions

#: Largest difference between the stamps of a depth image and its color image, where none is set; seconds.
ASSOCIATION_LIMIT_S = 0.02


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """What a user may specify besides a URI or path.

    Parameters
    ----------
    intrinsics : tuple of float or None
        ``(fx, fy, cx, cy)`` in pixels of the registered images, for recordings that bring none.
    depth_scale : float or None
        Depth units per meter of a recording that does not say it; None takes the format's own.
    association_limit_s : float
        Largest difference between the stamps of a depth image and its color image, seconds.
    depth_topic, color_topic : str or None
        Of an MCAP recording, the topics of the images; None chooses them.
    calibration : Calibration, Path or None
        Counts before `intrinsics`, and both before what a recording brings. A file, which may leave the
        images' sizes open, is read when a recording is opened. Of a camera, ``device.calibration`` counts.
    device : DeviceOptions or None
        Settings of a camera; None leaves them as they are.

    Raises
    ------
    ValueError
        If `depth_scale` or `association_limit_s` is not over 0.
    TypeError
        If `calibration` is something else, such as a text.
    """

    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float | None = None
    association_limit_s: float = ASSOCIATION_LIMIT_S
    depth_topic: str | None = None
    color_topic: str | None = None
    calibration: Calibration | Path | None = None
    device: DeviceOptions | None = None

    def __post_init__(self) -> None:
        # A calibration's class is imported late.
        is_known = self.calibration is None or isinstance(self.calibration, Path)
        if not is_known and not hasattr(self.calibration, "color_from_depth"):
            raise TypeError(f"calibration: expected a Calibration or a Path, got {self.calibration!r}")
        if self.intrinsics is not None and len(self.intrinsics) != 4:
            raise ValueError(f"intrinsics: expected fx, fy, cx, cy, got {self.intrinsics}")
        if self.depth_scale is not None and not 0 < self.depth_scale < float("inf"):
            raise ValueError(f"depth_scale: expected units per meter over 0, got {self.depth_scale}")
        if not 0 < self.association_limit_s < float("inf"):
            raise ValueError(f"association_limit_s: expected seconds over 0, got {self.association_limit_s}")

    def given_cameras(self) -> CameraFile | None:
        """Return the cameras that the user gives, as if a file said so; None where the user gives none.

        Raises CalibrationError if they are in a file that cannot be read.
        """
        from nurbseg.drivers.calibration.cameras import CameraFile

        if isinstance(self.calibration, Path):
            from nurbseg.drivers.calibration.file import read_camera_file

            return read_camera_file(self.calibration)
        if self.calibration is not None:
            return CameraFile.of_calibration(self.calibration, Path("--calibration"))
        return None if self.intrinsics is None else CameraFile.of_intrinsics(self.intrinsics)
