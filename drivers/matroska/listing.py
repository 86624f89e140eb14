"""What a recording of k4arecorder holds, and where its images are [1]_.

References
----------
.. [1] Microsoft, "Use Azure Kinect Sensor SDK to record file format".
"""

import logging
import os
import struct
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.limits import LIST_LINES_MAX, STAMP_END_NS, TEXT_BYTES_MAX
from nurbseg.drivers.matroska.elements import Element, fields, unsigned, variable, walk

_log = logging.getLogger(__name__)

# Kinds of elements.
_INFO, _TRACKS, _ATTACHMENTS, _TAGS = 0x1549A966, 0x1654AE6B, 0x1941A469, 0x1254C367
_TIMECODE, _SIMPLE_BLOCK, _BLOCK, _TIMECODE_SCALE = 0xE7, 0xA3, 0xA1, 0x2AD7B1
_TRACK, _NUMBER, _NAME, _CODEC, _PRIVATE, _ENCODINGS = 0xAE, 0xD7, 0x536E, 0x86, 0x63A2, 0x6D80
_VIDEO, _WIDTH, _HEIGHT = 0xE0, 0xB0, 0xBA
_FILE, _FILE_DATA = 0x61A7, 0x465C
_TAG, _SIMPLE_TAG, _TAG_NAME, _TAG_TEXT = 0x7373, 0x67C8, 0x45A3, 0x4487
#: Bytes of the elements that are not blocks, and of a tag.
_TABLE_BYTES_MAX, _TAG_BYTES_MAX = 4 * TEXT_BYTES_MAX, 256
#: Flags of a block that hold whether there are several frames in it.
_LACED = 0x06
#: The scale of times where it is not stated, nanoseconds.
_SCALE_NS = 1_000_000


@dataclass(slots=True)
class Track:
    """A track: what it is called, its images' form and size, and when and where each of them is.

    The readings of the accelerometer are a track as well, without form and size. `blocks` has three numbers
    for each image or reading: its time, nanoseconds, and from which to which byte it is.
    """

    name: str
    form: str
    size: tuple[int, int]
    is_encoded: bool
    blocks: "array[int]" = field(default_factory=lambda: array("q"))

    def sorted_blocks(self) -> NDArray[np.int64]:
        """Return the blocks in the order of their times, (N, 3) int64."""
        table = np.array(self.blocks, np.int64).reshape(-1, 3)
        return table[np.argsort(table[:, 0], kind="stable")]


class Listing:
    """The tracks of a file by their numbers, its tags, and the files attached to it.

    A file that is damaged, cut off or written still ends there, with a warning.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.tracks: dict[int, Track] = {}
        self.tags: dict[str, str] = {}
        self.attached: list[bytes] = []
        self._stream = stream
        self._scale_ns, self._cluster, self._count = _SCALE_NS, 0, 0
        try:
            for element in walk(stream, os.fstat(stream.fileno()).st_size):
                self._note(element)
        except ValueError as err:
            _log.warning("%s: is damaged: %s; it is replayed up to there", path, err)

    def _note(self, element: Element) -> None:
        if element.kind in (_SIMPLE_BLOCK, _BLOCK):
            self._note_block(element)
        elif element.kind == _TIMECODE:
            self._cluster = unsigned(self._content(element))
        elif element.kind == _INFO:
            stated = dict(fields(self._content(element)))
            self._scale_ns = unsigned(stated.get(_TIMECODE_SCALE, b"")) or _SCALE_NS
        elif element.kind == _TRACKS:
            for kind, content in fields(self._content(element)):
                if kind == _TRACK:
                    self._note_track(dict(fields(content)))
        elif element.kind == _ATTACHMENTS:
            files = [dict(fields(each)) for kind, each in fields(self._content(element)) if kind == _FILE]
            self.attached += [file[_FILE_DATA] for file in files if _FILE_DATA in file]
        elif element.kind == _TAGS:
            for kind, content in fields(self._content(element)):
                if kind == _TAG:
                    self._note_tags(content)

    def _note_block(self, element: Element) -> None:
        number, place = variable(element.first)
        track = self.tracks.get(number)
        if track is None or len(element.first) < place + 3:
            return
        relative, flags = struct.unpack_from(">hB", element.first, place)
        time_ns = (self._cluster + relative) * self._scale_ns
        self._count += 1
        if self._count > LIST_LINES_MAX:
            raise ValueError(f"expected {LIST_LINES_MAX} images at most")
        if (track.name == "imu" or not flags & _LACED) and 0 <= time_ns < STAMP_END_NS:
            track.blocks.extend((time_ns, element.start + place + 3, element.end))

    def _note_track(self, stated: dict[int, bytes]) -> None:
        video = dict(fields(stated.get(_VIDEO, b"")))
        size = unsigned(video.get(_WIDTH, b"")), unsigned(video.get(_HEIGHT, b""))
        codec, private = _text(stated.get(_CODEC, b"")), stated.get(_PRIVATE, b"")
        # Windows' description of an image names its form by four letters.
        form = _text(private[16:20]) if codec == "V_MS/VFW/FOURCC" else codec
        name = _text(stated.get(_NAME, b"")).casefold()
        if name in ("depth", "color", "imu"):
            self.tracks[unsigned(stated.get(_NUMBER, b""))] = Track(name, form, size, _ENCODINGS in stated)

    def _note_tags(self, content: bytes) -> None:
        for kind, tag in fields(content):
            if kind == _SIMPLE_TAG:
                stated = dict(fields(tag))
                name, text = (
                    _text(stated.get(each, b""))[:_TAG_BYTES_MAX] for each in (_TAG_NAME, _TAG_TEXT)
                )
                self.tags[name] = text

    def _content(self, element: Element) -> bytes:
        if element.end - element.start > _TABLE_BYTES_MAX:
            size = element.end - element.start
            raise ValueError(f"the element at byte {element.start} has {size} bytes, over {_TABLE_BYTES_MAX}")
        return os.pread(self._stream.fileno(), element.end - element.start, element.start)


def _text(content: bytes) -> str:
    return content.rstrip(b"\0").decode(errors="replace")
