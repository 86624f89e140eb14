"""Depth cameras and .oni recordings through OpenNI2."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.drivers.closing import closed_on_error
from nurbseg.drivers.openni2.options import DeviceOptions

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
    from nurbseg.drivers.openni2.isolated.source import IsolatedCamera, Reopening
    from nurbseg.drivers.reconnect import Reconnecting

    if rest.lower().endswith(".oni"):
        from nurbseg.drivers.openni2.oni.playback import OniSource

        return OniSource(Path(rest), options)
    settings, limit_s = options.device or DeviceOptions(), options.association_limit_s
    camera = IsolatedCamera(rest, settings, pairing_limit_s=limit_s)
    if not settings.reconnect:
        return camera
    with closed_on_error(camera.close):
        same = camera.metadata["serial"] or f"port:{camera.metadata['usb_port']}"
        reopen = Reopening(same, settings, limit_s)
    interval_s = min(settings.reconnect_interval_s, 0.1)
    return Reconnecting(camera, reopen, abandon=reopen.close, interval_s=interval_s)
