"""Depth cameras and .oni recordings through OpenNI2."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.drivers.openni2.options import DeviceOptions

if TYPE_CHECKING:
    from nurbseg.drivers.options import SourceOptions
    from nurbseg.drivers.process.child import ChildProcess
    from nurbseg.drivers.source import FrameSource

__all__ = ["DeviceOptions", "open_uri"]


def open_uri(rest: str, options: SourceOptions) -> FrameSource:
    """Open a camera, or an .oni recording.

    Parameters
    ----------
    rest : str
        What follows ``openni2:`` in the URI: "any" or nothing, "xtion", "kinect", "orbbec", OpenNI2's
        own URI of a device, a serial number, or the path of an .oni file.
    options : SourceOptions
        Its ``device`` has the camera's settings.

    Raises
    ------
    BackendMissingError
        If OpenNI2 is not installed.
    DeviceNotFoundError
        If there is no such camera.
    DriverError
        If the camera cannot do what is asked of it.
    RecordingFormatError
        If it is a recording, and damaged.
    """
    # Imported late: the options alone need neither numpy nor the library.
    from nurbseg.drivers.openni2.isolated.source import IsolatedCamera, begin_process
    from nurbseg.drivers.openni2.reopening import Reopening
    from nurbseg.drivers.reconnect import Reconnecting

    if rest.lower().endswith(".oni"):
        from nurbseg.drivers.openni2.oni.playback import open_path

        return open_path(Path(rest), options)
    settings = options.device or DeviceOptions()

    limit_s = options.association_limit_s
    camera = IsolatedCamera(rest, settings, pairing_limit_s=limit_s)
    if not settings.reconnect:
        return camera
    same = camera.metadata["serial"] or f"port:{camera.metadata['usb_port']}"
    interval_s = settings.reconnect_interval_s

    def open_again(process: ChildProcess) -> IsolatedCamera:
        return IsolatedCamera(same, settings, pairing_limit_s=limit_s, patience_s=interval_s, process=process)

    try:
        reopen = Reopening(lambda: begin_process(settings), open_again)
    except BaseException:
        camera.close()
        raise
    return Reconnecting(camera, reopen, abandon=reopen.close, interval_s=min(interval_s, 0.1))
