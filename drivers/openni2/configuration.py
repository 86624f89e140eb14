"""Applies a user's settings to a running camera, and reports which of them it took."""

import ctypes
import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Calibration
from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.openni2 import nominal
from nurbseg.drivers.openni2.capi import OniCropping, PixelFormat, StreamProperty
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import Stream
from nurbseg.drivers.options import DeviceOptions, parse_mode

logger = logging.getLogger(__name__)

_DEPTH_FORMATS = {"1mm": (PixelFormat.DEPTH_1_MM,), "100um": (PixelFormat.DEPTH_100_UM,)}
_COLOR_FORMATS = (PixelFormat.RGB888, PixelFormat.YUYV, PixelFormat.YUV422, PixelFormat.GRAY8)


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
    if registered:
        depth = color = given.color if given else nominal.from_field_of_view(*color_size, fov[1])
        color_from_depth: NDArray[np.float64] = np.eye(4)
    elif given:
        depth, color, color_from_depth = given.depth, given.color, given.color_from_depth
    else:
        logger.warning(
            "no calibration given: color is mapped to depth with PrimeSense's nominal values, which may "
            "be off by some pixels; use --calibration FILE for a measured one"
        )
        depth = nominal.from_field_of_view(*depth_size, fov[0])
        color, color_from_depth = nominal.color_camera(*color_size), nominal.color_from_depth()
    calibration = Calibration(
        nominal.fitted(depth, *depth_size), nominal.fitted(color, *color_size), color_from_depth
    )
    return nominal.mirrored(calibration) if options.mirror else calibration
