"""The files of a recording: one, or the parts of a bag that was split, which ROS 2 keeps in a folder."""

import logging
import re
import shlex
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import ROSBAG_MAGIC, SQLITE_MAGIC, open_regular, read_file, visible
from nurbseg.common.limits import TEXT_BYTES_MAX
from nurbseg.drivers.mcap.container.mcap_file import McapFile
from nurbseg.drivers.mcap.container.messages import Logged, Messages

_log = logging.getLogger(__name__)

METADATA = "metadata.yaml"
#: The kinds of files of which a bag is made.
SUFFIXES = (".mcap", ".db3")
_PART = re.compile(r"(?P<name>.+)_(?P<number>\d{1,6})(?P<suffix>\.mcap|\.db3)")


def parts_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are one recording, in their order; none if there are none.

    They are MCAP files or SQLite databases, in the order of ``metadata.yaml``, else of the numbers in
    ``NAME_0.mcap``, ``NAME_1.mcap``. The log warns about missing parts. Raises RecordingFormatError if the
    parts are compressed, or the metadata cannot be read.
    """
    expected = _listed(folder / METADATA)
    if not any((folder / name).exists() for name in expected):
        expected = _numbered(bag_files(folder))
    if not expected:
        if packed := sorted(path for suffix in SUFFIXES for path in visible(folder, f"*{suffix}.zstd")):
            names = " ".join(shlex.quote(str(path)) for path in packed)
            raise RecordingFormatError(
                f"{packed[0]}: the file as a whole is compressed by zstd; to unpack it: zstd -d {names}"
            )
        return []
    missing = [name for name in expected if not (folder / name).exists()]
    if missing:
        shown = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        _log.warning("%s: %d parts of the recording are missing: %s", folder, len(missing), shown)
    return [folder / name for name in expected if name not in missing]


def bag_files(folder: Path) -> list[Path]:
    """Return the files of a folder that may be parts of bags, by name."""
    return sorted(path for suffix in SUFFIXES for path in visible(folder, f"*{suffix}"))


def later_part(path: Path) -> str:
    """Return the advice for a file that its name calls a later part of a split bag; else an empty text."""
    match = _PART.fullmatch(path.name)
    if match is None or not int(match["number"]):
        return ""
    what = "by its name it is a later part of a split bag, whose first part may say it"
    return f"; {what}: name the folder with all parts ({path.parent})"


def _numbered(files: list[Path]) -> list[str]:
    """Return the names of the parts of which these are one bag, without gaps; none if they are not one."""
    found = {int(match["number"]): match for path in files if (match := _PART.fullmatch(path.name))}
    forms = {(match["name"], match["suffix"]) for match in found.values()}
    if len(found) != len(files) or len(forms) != 1:
        return []
    ((name, suffix),) = forms
    return [found[n].string if n in found else f"{name}_{n}{suffix}" for n in range(max(found) + 1)]


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
    information = table.get("rosbag2_bagfile_information") if isinstance(table, dict) else None
    names = information.get("relative_file_paths") if isinstance(information, dict) else None
    # Older versions name the folder, too; a file elsewhere is no part.
    found = [Path(str(name)).name for name in names] if isinstance(names, list) else []
    return [name for name in found if name.endswith(SUFFIXES)]


def open_messages(path: Path) -> Messages:
    """Open a file of a recording, or the folder of a split bag; raises RecordingFormatError if it is none."""
    if path.is_dir():
        return _Parts(path)
    with open_regular(path) as stream:
        head = stream.read(len(SQLITE_MAGIC))
    if head == SQLITE_MAGIC:
        from nurbseg.drivers.mcap.container.database import DatabaseFile

        return DatabaseFile(path)
    if head.startswith(ROSBAG_MAGIC):
        from nurbseg.drivers.mcap.container.ros1 import Ros1File  # late: its library takes long to import

        return Ros1File(path)
    return McapFile(path)


class _Parts(Messages):
    """The parts of a bag that was split, of which each begins where the one before ends."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._stack = ExitStack()
        self._files: list[Messages] = []
        with closed_on_error(self.close):
            for part in parts_in(folder) or bag_files(folder):
                self._files.append(self._stack.enter_context(open_messages(part)))
        self.form, self.profile = self._files[0].form, self._files[0].profile
        for file in self._files:
            self.whole &= file.whole
            self.span_ns += file.span_ns
            self.damage = self.damage or file.damage
            self.metadata |= file.metadata
            for name, topic in file.topics.items():
                before = self.topics.get(name, topic._replace(messages=0))
                self.topics[name] = before._replace(messages=before.messages + topic.messages)

    def close(self) -> None:
        """Close the files; safe to call twice."""
        self._stack.close()

    def messages(self, topics: Iterable[str], after: Any = None) -> Iterator[Logged | FrameFormatError]:
        """Yield the messages of some topics, part by part."""
        wanted = set(topics)
        first, place = after or (0, None)
        for number, file in enumerate(self._files[first:], first):
            for item in file.messages(wanted & file.topics.keys(), place if number == first else None):
                yield item._replace(after=(number, item.after)) if isinstance(item, Logged) else item
