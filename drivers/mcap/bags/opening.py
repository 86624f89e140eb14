"""Opens a file of ROS messages by what it is: MCAP, an SQLite database, or a bag of ROS 1."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.common.files import ROSBAG_MAGIC, SQLITE_MAGIC, open_regular
from nurbseg.drivers.mcap.container.file import McapFile

if TYPE_CHECKING:
    from nurbseg.drivers.mcap.bags.database import DatabaseFile
    from nurbseg.drivers.mcap.bags.ros1 import Ros1File


def open_bag_file(path: Path) -> McapFile | DatabaseFile | Ros1File:
    """Open one file of a recording; raises RecordingFormatError as those of its kind do."""
    with open_regular(path) as stream:
        head = stream.read(len(SQLITE_MAGIC))
    if head == SQLITE_MAGIC:
        from nurbseg.drivers.mcap.bags.database import DatabaseFile

        return DatabaseFile(path)
    if head.startswith(ROSBAG_MAGIC):
        from nurbseg.drivers.mcap.bags.ros1 import Ros1File

        return Ros1File(path)
    return McapFile(path)
