"""Recordings by OpenNI2's own recorder, and what a kill leaves of one."""

from __future__ import annotations

from pathlib import Path

from nurbseg.drivers.openni2.device import DeviceSource


def record_ten_frames(path: Path) -> bytes:
    """Record a camera; return what the file holds after ten frames, before it gets its end."""
    with DeviceSource() as source:
        source.start_recording(path)
        for _ in range(10):
            source.read()
        content = path.read_bytes()
        source.stop_recording()
    return content
