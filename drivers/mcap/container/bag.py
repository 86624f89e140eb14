"""The files of a recording: one, or the parts of a bag that was split, which ROS 2 keeps in a folder."""

import logging
import re
import shlex
from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.records import Channel, Message, Schema
from numpy.typing import NDArray

from nurbseg.common.closing import Closing
from nurbseg.common.errors import RecordingFormatError, quoted
from nurbseg.common.files import read_file, visible
from nurbseg.common.limits import TEXT_BYTES_MAX

_log = logging.getLogger(__name__)

METADATA = "metadata.yaml"
#: The kinds of files of which a bag is made.
SUFFIXES = (".mcap", ".db3")
_PART = re.compile(r"(?P<name>.+)_(?P<number>\d{1,18})(?P<suffix>\.mcap|\.db3)")
_INFORMATION = "rosbag2_bagfile_information"


def parts_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are one recording, in their order; none if there are none.

    They are MCAP files or SQLite databases, all of one kind.

    The order is that of ``metadata.yaml``, else of the numbers in ``NAME_0.mcap``, ``NAME_1.mcap``. A part
    that is missing is said. Raises RecordingFormatError if the parts are compressed, or the metadata cannot
    be read.
    """
    listed = [folder / name for name in _listed(folder / METADATA)]
    files = bag_files(folder)
    compressed = sorted(file for suffix in SUFFIXES for file in visible(folder, f"*{suffix}.zstd"))
    if compressed and not any(each.exists() for each in listed or files):
        names = " ".join(shlex.quote(str(each)) for each in compressed)
        raise RecordingFormatError(
            f"{compressed[0]}: the file as a whole is compressed by zstd; to unpack it: zstd -d {names}"
        )
    present = [each for each in listed if each.exists()]
    if present:
        missing = [each.name for each in listed if not each.exists()]
    else:
        numbered = sorted(
            (int(match["number"]), match["name"], file)
            for file in files
            if (match := _PART.fullmatch(file.name))
        )
        kinds = {(name, each.suffix) for _, name, each in numbered}
        if len(kinds) != 1 or len(numbered) != len(files):
            return []
        present = [each for *_, each in numbered]
        numbers = {number for number, *_ in numbered}
        missing = [
            f"{numbered[0][1]}_{n}{present[0].suffix}" for n in range(max(numbers)) if n not in numbers
        ]
    if missing:
        shown = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        _log.warning("%s: %d parts of the recording are missing: %s", folder, len(missing), shown)
    return present


def bag_files(folder: Path) -> list[Path]:
    """Return the files of a folder that may be parts of bags, by name."""
    return sorted(file for suffix in SUFFIXES for file in visible(folder, f"*{suffix}"))


def parts_before(path: Path) -> list[Path]:
    """Return the parts of a split bag that come before one of them and are there, the first one first."""
    match = _PART.fullmatch(path.name)
    if match is None:
        return []
    before = (
        path.with_name(f"{match['name']}_{number}{match['suffix']}") for number in range(_number(match))
    )
    return [each for each in before if each.is_file()]


def later_part(path: Path) -> str:
    """Say that a file is a later part of a split bag, if its name says so; else an empty text."""
    match = _PART.fullmatch(path.name)
    if match is None or not _number(match):
        return ""
    return (
        f"; by its name it is part {_number(match) + 1} of a split bag, whose first part may say it: "
        f"name the folder with all parts ({path.parent})"
    )


def _number(match: re.Match[str]) -> int:
    # As many parts as a folder can hold; a date is no number of a part.
    return min(int(match["number"]), 10_000)


def _listed(path: Path) -> list[str]:
    """Return the names that the metadata of a bag lists; none where there are no metadata."""
    if not path.is_file():
        return []
    # Most recordings have no metadata.
    from nurbseg.common.structured_text import parse_yaml

    try:
        table = parse_yaml(read_file(path, TEXT_BYTES_MAX, what="metadata").decode())
    except ValueError as err:
        raise RecordingFormatError(f"{path}: not valid YAML ({quoted(str(err))})") from err
    information = table.get(_INFORMATION) if isinstance(table, dict) else None
    names = information.get("relative_file_paths") if isinstance(information, dict) else None
    # Older versions name the folder, too; a file elsewhere is no part.
    found = [Path(str(name)).name for name in names or []] if isinstance(names, list) else []
    return [name for name in found if name.endswith(SUFFIXES)]


class Run(NamedTuple):
    """Messages of one channel in one entry: when they were logged, nanoseconds, and where they begin."""

    entry: int
    times_ns: NDArray[np.int64]
    offsets: NDArray[np.int64]


class MessageFile(Closing):
    """A file of ROS messages, opened for reading.

    `form` is what it is, for a person, and `profile` what its messages follow, such as "ros2"; `whole` is
    whether it reaches its end. Messages are found by entry and offset: with `has_chunks`, what is wrong with
    one of an entry is wrong with all. `damaged` says what is wrong with entries that cannot be gone through.
    Channels and schemas are all there after `find_messages`.
    """

    form: str
    has_chunks = True

    def __init__(self, path: Path, profile: str = "ros2") -> None:
        self.path, self.profile, self.whole = path, profile, True
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.damaged: dict[int, str] = {}

    @abstractmethod
    def find_messages(self) -> None:
        """Find out where the messages are."""

    @abstractmethod
    def runs(self, channel: int) -> Iterator[Run]:
        """Yield the messages of a channel, entry by entry."""

    @abstractmethod
    def message(self, entry: int, offset: int) -> Message:
        """Return a message; raises FrameFormatError if it cannot be read."""
