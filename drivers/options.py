"""What a user may specify besides a URI or path."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nurbseg.common.settings import Settings, setting

if TYPE_CHECKING:
    from nurbseg.common.frame import Calibration
    from nurbseg.drivers.calibration.cameras import CameraFile

DepthUnit = Literal["1mm", "100um"]
Registration = Literal["hardware", "software"]
Switch = Literal["keep", "on", "off"]
#: How color images are recorded: JPEG of quality 95, PNG, or as they are.
ColorFormat = Literal["jpeg95", "png", "raw"]

_MODE_NAMES = {"vga": (640, 480, 30), "qvga": (320, 240, 60), "sxga": (1280, 1024, 30)}
_MODE_TEXT = re.compile(r"(?P<width>\d{1,9})x(?P<height>\d{1,9})(@(?P<fps>\d{1,9}))?")


def parse_mode(text: str) -> tuple[int, int, int]:
    """Return width and height in pixels and frames per second of ``"640x480@30"`` or a name.

    The names are ``vga`` (640x480@30), ``qvga`` (320x240@60) and ``sxga`` (1280x1024@30), optionally followed
    by another rate: ``qvga30``. Without a rate, WxH means 30. Raises ValueError if `text` is neither.
    """
    found = _MODE_TEXT.fullmatch(text.lower())
    if found:
        return int(found["width"]), int(found["height"]), int(found["fps"] or 30)
    name = re.fullmatch(r"([a-z]+)@?(\d{0,9})", text.lower())
    if name and name[1] in _MODE_NAMES:
        width, height, fps = _MODE_NAMES[name[1]]
        return width, height, int(name[2] or fps)
    raise ValueError(f"expected a mode such as 640x480@30, vga, qvga or sxga, got {text!r}")


@dataclass(frozen=True, slots=True)
class DeviceOptions(Settings):
    """Settings of a camera; each is set after the streams start, and read back.

    Frames hold whole millimeters in either unit of depth: with 100um they are rounded here instead of by the
    camera. If the camera cannot register depth to color, frames carry the calibration with which software
    does it. Depth and color come at the same moment only where both streams have the same rate. Raises
    ValueError if a value is out of its bounds, or a mode cannot be read.
    """

    serial: str = setting("", "serial number of the camera, if there are several")
    depth_mode: str = setting("vga", "size and frame rate of the depth stream: 640x480@30, vga, qvga, ...")
    color_mode: str = setting(
        "vga", "size and frame rate of the color stream: 640x480@30, vga, qvga, sxga, ..."
    )
    depth_unit: DepthUnit = setting("1mm", "unit in which the camera delivers depth")
    mirror: bool = setting(False, "mirror the images")
    registration: Registration = setting("hardware", "what registers depth to color: camera or program")
    sync: bool = setting(True, "capture depth and color at the same time, if the camera can")
    auto_exposure: Switch = setting("keep", "automatic exposure of the color camera")
    auto_white_balance: Switch = setting("keep", "automatic white balance of the color camera")
    exposure: int | None = setting(None, "exposure of the color camera, in its own units", least=0)
    gain: int | None = setting(None, "gain of the color camera, in its own units", least=0)
    silence_limit_s: float = setting(
        3.0, "a camera silent for this long is considered lost", unit="s", least=0.1, flag="silence-limit"
    )
    calibration: str | None = setting(
        None, "calibration of the camera: TOML, OpenCV's YAML or XML, ROS camera_info YAML", unit="FILE"
    )
    reconnect: bool = setting(True, "wait for an unplugged camera, and resume when it is back")
    reconnect_interval_s: float = setting(
        0.5, "time between checks for a lost camera", unit="s", above=0.0, flag="reconnect-interval"
    )

    @property
    def color_controls(self) -> dict[str, int]:
        """What is asked of the color camera, by the settings' names; a switch is 1 or 0."""
        # Automatic controls first: while they are on, a camera may refuse the values.
        names = ("auto_exposure", "auto_white_balance", "exposure", "gain")
        asked = {name: getattr(self, name) for name in names}
        switches = {"on": 1, "off": 0}
        return {name: switches.get(each, each) for name, each in asked.items() if each not in (None, "keep")}

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        for name in ("depth_mode", "color_mode"):
            try:
                parse_mode(getattr(self, name))
            except ValueError as err:
                raise ValueError(f"{name}: {err}") from None


#: Address space that a process may take which reads a source, 10^6 bytes.
SOURCE_MEMORY_MB = 4000
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
    every_frame : bool
        Of a camera, return each frame in its order, of which up to a second waits, and not only the newest.
    memory_mb : int
        What a process that reads the source may take, 10^6 bytes.

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
    calibration: "Calibration | Path | None" = None
    device: DeviceOptions | None = None
    every_frame: bool = False
    memory_mb: int = SOURCE_MEMORY_MB

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

    def given_cameras(self) -> "CameraFile | None":
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
