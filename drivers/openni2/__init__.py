"""Depth cameras and .oni recordings through OpenNI2."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.common.closing import closed_on_error
from nurbseg.drivers.options import DeviceOptions

if TYPE_CHECKING:
    from nurbseg.drivers.options import SourceOptions
    from nurbseg.drivers.source import FrameSource

__all__ = ["DeviceOptions", "open_uri"]


def open_uri(rest: str, options: SourceOptions) -> FrameSource:
    """Open a camera with the settings in ``options.device``, or an .oni recording.

    `rest` is what follows ``openni2:`` in the URI: "any" or nothing, "xtion", "kinect", "orbbec", OpenNI2's
    own URI of a device, a serial number, or the path of an .oni file. Raises BackendMissingError if OpenNI2
    is not installed, DeviceNotFoundError if there is no such camera, DriverError if it cannot do what is
    asked of it, and RecordingFormatError if the recording is damaged.
    """
    # Imported late: the options alone need neither numpy nor the library.
    from nurbseg.drivers.live.isolated.source import IsolatedCamera
    from nurbseg.drivers.live.shared import SharedCamera
    from nurbseg.drivers.reconnect import Reconnecting

    if rest.lower().endswith(".oni"):
        from nurbseg.drivers.openni2.oni.playback import OniSource

        return OniSource(Path(rest), options)
    settings = options.device or DeviceOptions()
    open_camera = partial(IsolatedCamera, options=settings, pairing_limit_s=options.association_limit_s)
    camera = open_camera(rest)
    if not settings.reconnect:
        return SharedCamera(camera)
    with closed_on_error(camera.close):
        same = camera.metadata["serial"] or f"port:{camera.metadata['usb_port']}"
    interval_s = settings.reconnect_interval_s
    reopen = partial(open_camera, same, patience_s=interval_s)
    return SharedCamera(Reconnecting(camera, reopen, interval_s=interval_s))
