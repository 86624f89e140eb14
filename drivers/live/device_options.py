"""A camera's settings."""

import re
from dataclasses import dataclass
from typing import Literal

from nurbseg.common.settings import Settings, setting

DepthUnit = Literal["1mm", "100um"]
Registration = Literal["hardware", "software"]
Switch = Literal["keep", "on", "off"]

_MODE_NAMES = {"vga": (640, 480, 30), "qvga": (320, 240, 60), "sxga": (1280, 1024, 30)}
_MODE_TEXT = re.compile(r"(?P<width>\d+)x(?P<height>\d+)(@(?P<fps>\d+))?")


def parse_mode(text: str) -> tuple[int, int, int]:
    """Return width and height in pixels and frames per second of ``"640x480@30"`` or a name.

    The names are ``vga`` (640x480@30), ``qvga`` (320x240@60) and ``sxga`` (1280x1024@30), optionally followed
    by another rate: ``qvga30``. Without a rate, WxH means 30. Raises ValueError if `text` is neither.
    """
    found = _MODE_TEXT.fullmatch(text.lower())
    if found:
        return int(found["width"]), int(found["height"]), int(found["fps"] or 30)
    name = re.fullmatch(r"([a-z]+)@?(\d*)", text.lower())
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
        0.5,
        "time between checks for a lost camera",
        unit="s",
        above=0.0,
        flag="reconnect-interval",
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        for name in ("depth_mode", "color_mode"):
            try:
                parse_mode(getattr(self, name))
            except ValueError as err:
                raise ValueError(f"{name}: {err}") from None
