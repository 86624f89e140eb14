"""A camera of OpenNI2 read by a process of its own: every frame in its order, until it is lost."""

from dataclasses import replace
from typing import Any

from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.process.client import SourceProcess


def apart(wanted: str = "any", options: DeviceOptions | None = None, **others: Any) -> SourceProcess:
    device = replace(options or DeviceOptions(), reconnect=False)
    return SourceProcess(f"openni2:{wanted}", SourceOptions(device=device, every_frame=True, **others))
