"""RealSense cameras through their own SDK, pyrealsense2: ``pip install 'nurbseg[realsense]'``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from nurbseg.common.closing import closed_on_error
from nurbseg.drivers.options import DeviceOptions

if TYPE_CHECKING:
    from nurbseg.drivers.options import SourceOptions
    from nurbseg.drivers.source import FrameSource


def open_uri(rest: str, options: SourceOptions) -> FrameSource:
    """Open a camera with the settings in ``options.device``.

    `rest` is what follows ``realsense:`` in the URI: "any" or nothing, or a serial number. Raises
    BackendMissingError if the SDK is not installed, DeviceNotFoundError if there is no such camera, and
    DriverError if it cannot do what is asked of it.
    """
    # Imported late: the options alone need neither numpy nor the SDK.
    from nurbseg.drivers.live.isolated.source import IsolatedCamera
    from nurbseg.drivers.live.shared import SharedCamera
    from nurbseg.drivers.reconnect import Reconnecting

    settings = options.device or DeviceOptions()
    open_camera = partial(
        IsolatedCamera, options=settings, pairing_limit_s=options.association_limit_s, driver="realsense"
    )
    camera = open_camera(rest)
    if not settings.reconnect:
        return SharedCamera(camera)
    with closed_on_error(camera.close):
        same = camera.metadata["serial"]
    interval_s = settings.reconnect_interval_s
    reopen = partial(open_camera, same, patience_s=interval_s)
    return SharedCamera(Reconnecting(camera, reopen, interval_s=interval_s))
