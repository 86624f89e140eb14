"""Recordings in the layout of the TUM RGB-D benchmark: lists of images by time, or of associated pairs."""

import bisect
import logging
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import read_file
from nurbseg.common.limits import LIST_BYTES_MAX, LIST_LINES_MAX, STAMP_END_NS
from nurbseg.common.structured_text import decode_text
from nurbseg.drivers.calibration.foreign import stand_in
from nurbseg.drivers.datasets.beside import poses_at
from nurbseg.drivers.datasets.folders import PairSource, shots_of
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

#: Digits of a stamp: seconds since 1970 with nanoseconds have 20.
_STAMP_CHARACTERS_MAX = 40
_NAME_CHARACTERS_MAX = 1024
#: Seconds since 1970 that stamps are before.
_END_S = STAMP_END_NS // 1_000_000_000
#: Partners considered for an image: only a list that is not a camera's has more within the limit.
_NEAR_MAX = 64
#: Of the images of the slower camera, the share that have a partner where the clocks and the limit are right.
_FOUND_MIN = 0.8
_UNIT = DepthUnit(5000.0, "TUM RGB-D's own")
_COLOR_LIST, _DEPTH_LIST = "rgb.txt", "depth.txt"
#: A list of pairs, as ``associate.py`` writes it.
_ASSOCIATIONS = "associations.txt"


def is_tum(folder: Path) -> bool:
    """Whether a folder has two lists, or one of pairs."""
    return _has_lists(folder) or (folder / _ASSOCIATIONS).is_file()


def _has_lists(folder: Path) -> bool:
    return (folder / _COLOR_LIST).is_file() and (folder / _DEPTH_LIST).is_file()


def associate(first: list[int], second: list[int], limit: int) -> list[tuple[int, int]]:
    """Pair two ascending lists of times, nearest first, each time being used once.

    Returns the ascending indices into the two lists of pairs that differ by `limit` at most, in the same
    unit.
    """
    near = []
    for place, moment in enumerate(first):
        middle = bisect.bisect_left(second, moment)
        begin = max(bisect.bisect_left(second, moment - limit), middle - _NEAR_MAX // 2)
        end = min(bisect.bisect_right(second, moment + limit), middle + _NEAR_MAX // 2)
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

    It holds rgb.txt, depth.txt, or else a list of pairs (associations.txt), the images they name, and the
    calibration unless `options` do. Images without a partner within ``options.association_limit_s`` are
    dropped and counted in ``metadata["dropped"]``. Depth has 5000 units per meter unless ``camera.toml`` or
    the user states another unit.

    Raises RecordingFormatError if a list is damaged, or no pair can be used; CalibrationError if there is no
    calibration, or an unusable one.

    References
    ----------
    .. [1] J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A benchmark for the evaluation of
       RGB-D SLAM systems", IROS 2012.
    """

    def __init__(self, folder: Path, options: SourceOptions) -> None:
        if _has_lists(folder):
            pairs, moments, dropped = _of_lists(folder, options.association_limit_s)
        else:
            pairs, moments, dropped = _of_associations(folder / _ASSOCIATIONS)
        self._folder = folder.resolve()
        shots = shots_of(folder, pairs, options, layout=_UNIT, moments_ns=moments)
        shots = [
            shot if pose is None else replace(shot, pose=pose @ shot.cameras.color_from_depth)
            for shot, pose in zip(shots, poses_at(folder, moments), strict=True)
        ]
        super().__init__(folder, shots, "TUM RGB-D", dropped)

    def _pair(self, index: int) -> ImagePair:
        """Return the files of a frame, which must be in the recording's folder, links resolved."""
        pair = super()._pair(index)
        for path in (pair.color or pair.depth, pair.depth):
            try:
                if path.resolve().is_relative_to(self._folder):
                    continue
            except (OSError, ValueError, RuntimeError) as err:
                name = quoted(str(path).removeprefix(f"{self._path}/"))
                raise FrameFormatError(f"{self._path}: {name}: not the name of an image ({err})") from err
            raise FrameFormatError(f"{path}: the image is outside the recording's folder; copy it there")
        return pair


def _of_lists(folder: Path, limit_s: float) -> tuple[list[ImagePair], list[int], int]:
    """Return the pairs of two lists, their times, and how many images have no partner."""
    colors, no_colors = _read_list(folder / _COLOR_LIST)
    depths, no_depths = _read_list(folder / _DEPTH_LIST)
    found = associate([ns for ns, _ in colors], [ns for ns, _ in depths], round(limit_s * 1e9))
    if not found:
        raise RecordingFormatError(
            f"{folder}: none of {len(colors)} color and {len(depths)} depth images are within {limit_s} s of "
            "each other"
        )
    if len(found) < _FOUND_MIN * min(len(colors), len(depths)):
        text = "%s: only %d of %d depth images have color within %g s (--set association_limit_s=S)"
        _log.warning(text, folder, len(found), len(depths), limit_s)
    pairs = [
        ImagePair(Path(depths[d][1]).stem, folder / colors[c][1], folder / depths[d][1]) for c, d in found
    ]
    single = len(colors) + len(depths) - 2 * len(found)
    return pairs, [depths[d][0] for _, d in found], single + no_colors + no_depths


def _of_associations(path: Path) -> tuple[list[ImagePair], list[int], int]:
    """Return the pairs that a list names, their times, and how many lines could not be used."""
    pairs, moments = [], []
    rows, bad = _read_rows(path, "seconds file seconds file")
    for (first_ns, first), (second_ns, second) in rows:
        # Either comes first: associate.py names color before depth, ICL-NUIM depth before color.
        depth_first = first.casefold().count("depth") > second.casefold().count("depth")
        color, depth = (second, first) if depth_first else (first, second)
        pairs.append(ImagePair(Path(depth).stem, path.parent / color, path.parent / depth))
        moments.append(first_ns if depth_first else second_ns)
    return pairs, moments, bad


def _read_list(path: Path) -> tuple[list[tuple[int, str]], int]:
    """Return the times and names of a list in order of time, and how many lines could not be used."""
    rows, bad = _read_rows(path, "seconds file")
    # Of images with the same time, the first counts.
    images = {moment_ns: name for ((moment_ns, name),) in reversed(rows)}
    if repeated := len({row[0] for row in rows}) - len(images):
        _log.warning("%s: %d images have the time of another one, and are left out", path, repeated)
    return sorted(images.items()), bad + repeated


def _read_rows(path: Path, form: str) -> tuple[list[list[tuple[int, str]]], int]:
    """Return the times and names in each line of a list, and how many lines could not be used.

    Raises RecordingFormatError if no line is of this `form`.
    """
    words_least = len(form.split())
    rows: list[list[tuple[int, str]]] = []
    bad, wrong = 0, f"{path}: expected lines of '{form}', got none"
    for place, line in enumerate(_lines(path), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        stamps, names = words[:words_least:2], words[1:words_least:2]
        try:
            if len(words) < words_least or max(map(len, names)) > _NAME_CHARACTERS_MAX:
                raise ValueError(f"expected {words_least} words, names of {_NAME_CHARACTERS_MAX} at most")
            rows.append([(_moment_ns(stamp), name) for stamp, name in zip(stamps, names, strict=True)])
        except (InvalidOperation, ValueError):
            wrong = wrong if bad else f"{path}: line {place}: expected '{form}', got {quoted(line)}"
            bad += 1
    if not rows:
        raise RecordingFormatError(wrong)
    if bad:
        _log.warning("%s; %d lines are skipped", wrong, bad)
    return rows, bad


def _lines(path: Path) -> list[str]:
    content = read_file(path, LIST_BYTES_MAX, what="list")
    if (kind := stand_in(content)) is not None:
        raise RecordingFormatError(f"{path}: {kind}")
    # Other programs separate by commas, or write names as Windows does.
    lines = decode_text(content, "replace").translate(str.maketrans(",\\", " /")).splitlines()
    if len(lines) > LIST_LINES_MAX:
        raise RecordingFormatError(f"{path}: expected {LIST_LINES_MAX} lines at most, got {len(lines)}")
    return lines


def _moment_ns(word: str) -> int:
    if len(word) > _STAMP_CHARACTERS_MAX:
        raise ValueError(f"expected {_STAMP_CHARACTERS_MAX} characters at most")
    # Seconds since 1970 to the microsecond have more digits than a float keeps.
    seconds = Decimal(word)
    if not 0 <= seconds < _END_S:
        raise ValueError("expected seconds from 1970 to 2038")
    return int(seconds * 1_000_000_000)
