"""Recordings in the layout of the TUM RGB-D benchmark: rgb.txt and depth.txt list images by time."""

from __future__ import annotations

import bisect
import logging
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.drivers.datasets.folders import first_calibration, folder_camera, load_pair
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.datasets.sequence import SequenceSource
from nurbseg.drivers.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.drivers.files import read_file
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.limits import LIST_BYTES_MAX, LIST_LINES_MAX, STAMP_END_NS

if TYPE_CHECKING:
    from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

_UNITS_PER_METRE = 5000.0
#: Digits of a stamp: seconds since 1970 with nanoseconds have 20.
_STAMP_CHARACTERS_MAX = 40
_NAME_CHARACTERS_MAX = 1024
#: Partners looked at for an image: more are within the limit only where a list is not one of a camera.
_NEAR_MAX = 64
COLOR_LIST, DEPTH_LIST = "rgb.txt", "depth.txt"


def is_tum(folder: Path) -> bool:
    """Whether a folder has the two lists."""
    return (folder / COLOR_LIST).is_file() and (folder / DEPTH_LIST).is_file()


def associate(first_ns: list[int], second_ns: list[int], limit_ns: int) -> list[tuple[int, int]]:
    """Pair two sorted lists of times, nearest first, each time being used once.

    Parameters
    ----------
    first_ns, second_ns : list of int
        Ascending times, nanoseconds.
    limit_ns : int
        Largest difference of a pair.

    Returns
    -------
    list of (int, int)
        Indices into the two lists, ascending.
    """
    near = []
    for place, moment in enumerate(first_ns):
        middle = bisect.bisect_left(second_ns, moment)
        for other in range(max(0, middle - _NEAR_MAX // 2), min(len(second_ns), middle + _NEAR_MAX // 2)):
            if abs(second_ns[other] - moment) <= limit_ns:
                near.append((abs(second_ns[other] - moment), place, other))
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, place, other in sorted(near):
        if place not in pairs and other not in taken:
            pairs[place] = other
            taken.add(other)
    return sorted(pairs.items())


class TumSource(SequenceSource):
    """Replays a TUM RGB-D folder; a frame's time is its depth image's.

    Images without a partner within ``options.association_limit_s`` are dropped and counted in
    ``metadata["dropped"]``. Depth has 5000 units per metre unless the folder or the user says otherwise.

    Parameters
    ----------
    folder : Path
        Holds rgb.txt, depth.txt, the images they name, and the calibration unless `options` do.
    options : SourceOptions
        Intrinsics, depth scale and association limit.

    Raises
    ------
    RecordingFormatError
        If a list is damaged, or no pair can be used.
    CalibrationError
        If there is no calibration, or an unusable one.

    References
    ----------
    .. [1] J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A benchmark for the evaluation of
       RGB-D SLAM systems", IROS 2012.
    """

    def __init__(self, folder: Path, options: SourceOptions) -> None:
        (colors, no_colors), (depths, no_depths) = (
            _read_list(folder / name) for name in (COLOR_LIST, DEPTH_LIST)
        )
        limit_ns = round(options.association_limit_s * 1e9)
        found = associate([ns for ns, _ in colors], [ns for ns, _ in depths], limit_ns)
        if not found:
            raise RecordingFormatError(
                f"{folder}: none of {len(colors)} color and {len(depths)} depth images are within "
                f"{options.association_limit_s} s of each other"
            )
        self._reading = folder_camera(folder, options, _UNITS_PER_METRE)
        single = len(colors) + len(depths) - 2 * len(found)
        super().__init__(folder, len(found), dropped=single + no_colors + no_depths)
        self._folder = folder
        self._pairs = [(colors[c][1], depths[d][1]) for c, d in found]
        self._moments_ns = [depths[d][0] for _, d in found]
        self.calibration = first_calibration(self._pair, len(found), self._reading)
        self.metadata = {
            "format": "TUM RGB-D",
            "frames": str(len(found)),
            "dropped": str(self.dropped),
            "calibration": self._reading.origin,
        }

    def _load(self, index: int) -> RGBDFrame:
        return load_pair(self._pair(index), self._reading, index, self._moments_ns[index])

    def _pair(self, index: int) -> ImagePair:
        color, depth = (_inside(self._folder, name) for name in self._pairs[index])
        return ImagePair(depth.stem, color, depth)


def _inside(folder: Path, name: str) -> Path:
    """Return the path of a listed image, which is in the recording's folder whatever links lead to it."""
    path = folder / name
    try:
        resolved = path.resolve()
    except (OSError, ValueError, RuntimeError) as err:
        raise FrameFormatError(f"{folder}: {quoted(name)}: not the name of an image ({err})") from err
    if not resolved.is_relative_to(folder.resolve()):
        raise FrameFormatError(f"{path}: the image is outside the recording's folder; copy it there")
    return path


def _read_list(path: Path) -> tuple[list[tuple[int, str]], int]:
    """Return the times and names of a list in order of time, and how many lines could not be used."""
    content = read_file(path, LIST_BYTES_MAX, what="list")
    lines = content.decode(errors="replace").splitlines()
    if len(lines) > LIST_LINES_MAX:
        raise RecordingFormatError(f"{path}: expected {LIST_LINES_MAX} lines at most, got {len(lines)}")
    images: dict[int, str] = {}
    bad = 0
    wrong = ""
    for place, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            moment_ns, name = _moment_ns(words[0]), words[1]
            if len(name) > _NAME_CHARACTERS_MAX:
                raise ValueError(f"expected a name of {_NAME_CHARACTERS_MAX} characters at most")
        except (InvalidOperation, IndexError, ValueError):
            bad += 1
            wrong = wrong or f"{path}: line {place}: expected 'seconds file', got {quoted(line)}"
            continue
        # Two images of one moment are one too many.
        bad += moment_ns in images
        images[moment_ns] = name
    if wrong and not images:
        raise RecordingFormatError(wrong)
    if wrong:
        _log.warning("%s; %d lines are passed over", wrong, bad)
    return sorted(images.items()), bad


def _moment_ns(word: str) -> int:
    if len(word) > _STAMP_CHARACTERS_MAX:
        raise ValueError(f"expected {_STAMP_CHARACTERS_MAX} characters at most")
    # Seconds since 1970 to the microsecond have more digits than a float keeps.
    seconds = Decimal(word)
    if not 0 <= seconds < STAMP_END_NS // 1_000_000_000:
        raise ValueError("expected seconds from 1970 to 2038")
    return int(seconds * 1_000_000_000)
