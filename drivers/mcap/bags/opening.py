"""Opens a file of ROS messages by what it is: MCAP, an SQLite database, or a bag of ROS 1."""

from pathlib import Path

from nurbseg.drivers.files import SQLITE_MAGIC, open_regular
from nurbseg.drivers.mcap.bags.database import DatabaseFile
from nurbseg.drivers.mcap.container.file import McapFile


def open_bag_file(path: Path) -> McapFile | DatabaseFile:
    """Open one file of a recording; raises RecordingFormatError as those of its kind do."""
    with open_regular(path) as stream:
        head = stream.read(len(SQLITE_MAGIC))
    if head == SQLITE_MAGIC:
        return DatabaseFile(path)
    return McapFile(path)
