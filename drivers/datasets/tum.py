"""Recordings in the layout of the TUM RGB-D benchmark: rgb.txt and depth.txt list images by time."""

import bisect
import logging
from decimal import Decimal, InvalidOperation
from pathlib import Path

from nurbseg.drivers.datasets.folders import PairSource, Shot, folder_cameras
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.drivers.files import read_file
from nurbseg.drivers.limits import LIST_BYTES_MAX, LIST_LINES_MAX, STAMP_END_NS
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

#: Digits of a stamp: seconds since 1970 with nanoseconds have 20.
_STAMP_CHARACTERS_MAX = 40
_NAME_CHARACTERS_MAX = 1024
#: Partners considered for an image: only a list that is not a camera's has more within the limit.
_NEAR_MAX = 64
COLOR_LIST, DEPTH_LIST = "rgb.txt", "depth.txt"


def is_tum(folder: Path) -> bool:
    """Whether a folder has the two lists."""
    return (folder / COLOR_LIST).is_file() and (folder / DEPTH_LIST).is_file()


def associate(first: list[int], second: list[int], limit: int) -> list[tuple[int, int]]:
    """Pair two ascending lists of times, nearest first, each time being used once.

    Returns the ascending indices into the two lists of pairs that differ by `limit` at most, in the same
    unit.
    """
    near = []
    for place, moment in enumerate(first):
        begin, end = bisect.bisect_left(second, moment - limit), bisect.bisect_right(second, moment + limit)
        if end - begin > _NEAR_MAX:
            middle = bisect.bisect_left(second, moment)
            begin, end = max(begin, middle - _NEAR_MAX // 2), min(end, middle + _NEAR_MAX // 2)
        near += [(abs(second[other] - moment), place, other) for other in range(begin, end)]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, place, other in sorted(near):
        if place not in pairs and other not in taken:
            pairs[place] = other
            taken.add(other)
    return sorted(pairs.items())


class TumSource(PairSource):
    """Replays a TUM RGB-D folder; a frame's time is its depth image's.

    It holds rgb.txt, depth.txt, the images they name, and the calibration unless `options` do. Images without
    a partner within ``options.association_limit_s`` are dropped and counted in ``metadata["dropped"]``. Depth
    has 5000 units per metre unless the folder or the user says otherwise.

    Raises RecordingFormatError if a list is damaged, or no pair can be used; CalibrationError if there is no
    calibration, or an unusable one.

    References
    ----------
    .. [1] J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A benchmark for the evaluation of
       RGB-D SLAM systems", IROS 2012.
    """

    _units_per_metre = 5000.0

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
        cameras = folder_cameras(folder, options)
        shots = []
        for c, d in found:
            color, depth = folder / colors[c][1], folder / depths[d][1]
            shots.append(Shot(ImagePair(depth.stem, color, depth), cameras, depths[d][0]))
        single = len(colors) + len(depths) - 2 * len(found)
        self._folder = folder.resolve()
        super().__init__(folder, shots, "TUM RGB-D", dropped=single + no_colors + no_depths)

    def _pair(self, index: int) -> ImagePair:
        """Return the files of a frame, which must be in the recording's folder, links resolved."""
        pair = super()._pair(index)
        for path in (pair.color, pair.depth):
            try:
                inside = path.resolve().is_relative_to(self._folder)
            except (OSError, ValueError, RuntimeError) as err:
                name = quoted(str(path).removeprefix(f"{self._path}/"))
                raise FrameFormatError(f"{self._path}: {name}: not the name of an image ({err})") from err
            if not inside:
                raise FrameFormatError(f"{path}: the image is outside the recording's folder; copy it there")
        return pair


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
        # Of two images with the same time, one is dropped.
        bad += moment_ns in images
        images[moment_ns] = name
    if wrong and not images:
        raise RecordingFormatError(wrong)
    if wrong:
        _log.warning("%s; %d lines are skipped", wrong, bad)
    return sorted(images.items()), bad


def _moment_ns(word: str) -> int:
    if len(word) > _STAMP_CHARACTERS_MAX:
        raise ValueError(f"expected {_STAMP_CHARACTERS_MAX} characters at most")
    # Seconds since 1970 to the microsecond have more digits than a float keeps.
    seconds = Decimal(word)
    if not 0 <= seconds < STAMP_END_NS // 1_000_000_000:
        raise ValueError("expected seconds from 1970 to 2038")
    return int(seconds * 1_000_000_000)
