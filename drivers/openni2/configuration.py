"""Applies a user's settings to a running camera, and makes its calibration by them and what it reports."""

import ctypes
import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.openni2.capi import OniCropping, PixelFormat, StreamProperty
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import Stream
from nurbseg.drivers.options import DeviceOptions, parse_mode

logger = logging.getLogger(__name__)

_DEPTH_FORMATS = {"1mm": (PixelFormat.DEPTH_1_MM,), "100um": (PixelFormat.DEPTH_100_UM,)}
_COLOR_FORMATS = (PixelFormat.RGB888, PixelFormat.YUYV, PixelFormat.YUV422, PixelFormat.GRAY8)
#: Horizontal field of view of the depth camera of PrimeSense's design, radians: 570.3 pixels at VGA.
DEPTH_FOV = 1.0226
#: Focal length of its color camera at VGA, pixels.
COLOR_FOCAL_PX = 525.0
#: How far the color camera is to the right of the depth camera, meters.
BASELINE_M = 0.025


def set_modes(depth: Stream, color: Stream, options: DeviceOptions) -> None:
    """Set sizes, rates and formats, before the streams start; raises as `Stream.set_mode` does."""
    depth.set_mode(*parse_mode(options.depth_mode), _DEPTH_FORMATS[options.depth_unit])
    color.set_mode(*parse_mode(options.color_mode), _COLOR_FORMATS)
    for stream in (depth, color):
        cropping = stream.find(StreamProperty.CROPPING, OniCropping)
        if cropping is not None and cropping.enabled:
            stream.try_to_set(StreamProperty.CROPPING, OniCropping())


def configure(
    device: OpenedDevice, options: DeviceOptions, name: str
) -> tuple[bool, tuple[bool, bool], dict[str, str]]:
    """Set everything else, after the streams have started: some devices silently ignore it before.

    `name` is what messages call the camera. Returns whether depth is registered, whether depth and color are
    mirrored here, where the camera does not mirror as asked, and what is on and off, for a person and for
    recordings.
    """
    depth, color = device.streams
    # With two rates OpenNI2 would find no two images of the same number, and deliver none.
    same_rate = depth.mode.fps == color.mode.fps
    synchronized = options.sync and same_rate and device.synchronize()
    if options.sync and not same_rate:
        logger.info("%s: depth and color have different frame rates and are not synchronized", name)
    wants_registration = options.registration == "hardware"
    registered = device.register(wants_registration)
    if wants_registration and not registered:
        reason = "it stays off when requested" if device.can_register else "it cannot"
        logger.warning("%s does not register depth to color (%s): software does it instead", name, reason)
    states = {
        "depth_mode": str(depth.mode),
        "color_mode": str(color.mode),
        "sync": "on" if synchronized else "off",
        "registration": "hardware" if registered else "software",
        "mirror": "on" if options.mirror else "off",
    }
    flips = (_must_flip(depth, options.mirror), _must_flip(color, options.mirror))
    _set_color_controls(color, options, name, states)
    return registered, flips, states


def _must_flip(stream: Stream, mirror: bool) -> bool:
    """Ask a stream to mirror, or not to; return whether it does otherwise."""
    stream.try_to_set(StreamProperty.MIRRORING, ctypes.c_int(mirror))
    return bool(stream.find(StreamProperty.MIRRORING, ctypes.c_int)) != mirror


def _set_color_controls(color: Stream, options: DeviceOptions, name: str, states: dict[str, str]) -> None:
    for field, value in options.color_controls.items():
        control = StreamProperty[field.upper()]
        if not color.try_to_set(control, ctypes.c_int(value)):
            logger.warning("%s does not accept %s %s", name, field, getattr(options, field))
        states[field] = str(color.find(control, ctypes.c_int))


def calibrate(
    depth_size: tuple[int, int],
    color_size: tuple[int, int],
    fov: tuple[float | None, float | None],
    options: DeviceOptions,
    *,
    registered: bool,
    cameras: CameraFile | None = None,
) -> Calibration:
    """Return the calibration of what two streams deliver.

    Sizes are (width, height) in pixels; `fov` are the horizontal fields of view of depth and color, radians,
    where known. The options may name a calibration file and mirror the images; `cameras` is a calibration
    that the user gives in another way. Depth that is `registered` is seen from the color camera. Raises
    CalibrationError if the calibration file is damaged or does not fit.
    """
    if options.calibration is not None:
        from nurbseg.drivers.calibration.file import read_camera_file

        cameras = read_camera_file(Path(options.calibration))
    given = cameras and cameras.calibration(
        depth_size=cameras.depth.size or depth_size, color_size=cameras.color.size or color_size
    )
    color_from_depth: NDArray[np.float64] = np.eye(4)
    if registered:
        depth = color = given.color if given else from_field_of_view(*color_size, fov[1])
    elif given:
        depth, color, color_from_depth = given.depth, given.color, given.color_from_depth
    else:
        logger.warning(
            "no calibration given: color is mapped to depth with PrimeSense's nominal values, which may "
            "be off by some pixels; use --calibration FILE for a measured one"
        )
        depth, color = from_field_of_view(*depth_size, fov[0]), color_camera(*color_size)
        color_from_depth[0, 3] = -BASELINE_M
    calibration = Calibration(fitted(depth, *depth_size), fitted(color, *color_size), color_from_depth)
    return mirrored(calibration) if options.mirror else calibration


def _pinhole(width: int, height: int, focal_px: float) -> Intrinsics:
    """Return a camera that looks straight ahead, with the 4:3 view that these cameras have.

    An SXGA image is 5:4: it goes on below the view that the 4:3 modes show, so its optical axis is
    where it would be in the upper 1280x960 pixels.
    """
    cy = width * 3 / 8 - 0.5 if height * 4 > width * 3 else height / 2 - 0.5
    return Intrinsics(width, height, focal_px, focal_px, width / 2 - 0.5, cy)


def from_field_of_view(width: int, height: int, horizontal_fov: float | None) -> Intrinsics:
    """Return intrinsics by the field of view, radians; by the nominal one where that makes no sense."""
    fov = horizontal_fov if horizontal_fov is not None and 0.1 < horizontal_fov < 3.0 else DEPTH_FOV
    return _pinhole(width, height, width / (2 * math.tan(fov / 2)))


def color_camera(width: int, height: int) -> Intrinsics:
    """Return the nominal color camera for images of this size, pixels."""
    return _pinhole(width, height, COLOR_FOCAL_PX * width / 640)


def fitted(camera: Intrinsics, width: int, height: int) -> Intrinsics:
    """Return a calibrated camera for images of another size, given how 5:4 and 4:3 modes overlap."""
    return replace(camera.scaled_to(width, round(camera.height * width / camera.width)), height=height)


def mirrored(calibration: Calibration) -> Calibration:
    """Return the calibration of the same cameras with both images mirrored left to right."""
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    return Calibration(
        depth=_mirrored_camera(calibration.depth),
        color=_mirrored_camera(calibration.color),
        color_from_depth=flip @ calibration.color_from_depth @ flip,
    )


def _mirrored_camera(camera: Intrinsics) -> Intrinsics:
    # The terms that are odd in x: p2, the thin prism's s1 and s2, and the tilt about the y axis.
    is_odd = np.isin(np.arange(camera.distortion.size), (3, 8, 9, 13))
    distortion = np.where(is_odd, -camera.distortion, camera.distortion)
    return replace(camera, cx=camera.width - 1 - camera.cx, distortion=distortion)
