"""Recordings in the layout of the TUM RGB-D benchmark: lists of images by time, or of associated pairs."""

import bisect
import itertools
import logging
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from statistics import median

from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import read_file
from nurbseg.common.limits import LIST_BYTES_MAX, LIST_LINES_MAX, STAMP_END_NS
from nurbseg.common.structured_text import decode_text
from nurbseg.drivers.calibration.foreign import stand_in
from nurbseg.drivers.datasets.folders import PairSource, shots_of
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.datasets.poses import poses_at
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

_log = logging.getLogger(__name__)

#: Digits of a stamp: seconds since 1970 with nanoseconds have 20.
_STAMP_CHARACTERS_MAX = 40
_NAME_CHARACTERS_MAX = 1024
#: Seconds since 1970 that stamps are before, and those of 2001.
_END_S, _SINCE_2001_S = STAMP_END_NS // 1_000_000_000, 1_000_000_000
#: No camera takes images that seldom, seconds; of a clock since a computer's start they are milliseconds.
_STEP_MAX_S = 5
#: Partners considered for an image: only a list that is not a camera's has more within the limit.
_NEAR_MAX = 64
#: Of the images of the slower camera, the share that have a partner where the clocks and the limit are right.
_FOUND_MIN = 0.8
_TUM, _OPENLORIS = DepthUnit(5000.0, "TUM RGB-D's own"), DepthUnit(1000.0, "OpenLORIS's own")
#: The lists of color and of depth images, and the unit of these.
_LISTS = (
    ("rgb.txt", "depth.txt", _TUM),
    ("color.txt", "aligned_depth.txt", _OPENLORIS),
    ("color.txt", "depth.txt", _OPENLORIS),
)
#: Lists of pairs, as ``associate.py`` writes them.
_ASSOCIATIONS = ("associations.txt", "association.txt", "associated.txt", "associate.txt")
#: Stamps of pairs that are numbers of frames: whole and below this.
_FRAME_NUMBERS = 1_000_000


def is_tum(folder: Path) -> bool:
    """Whether a folder has two lists, or one of pairs."""
    return _lists(folder) is not None or _associations(folder) is not None


def _lists(folder: Path) -> tuple[str, str, DepthUnit] | None:
    return next((each for each in _LISTS if all((folder / name).is_file() for name in each[:2])), None)


def _associations(folder: Path) -> Path | None:
    return next((folder / name for name in _ASSOCIATIONS if (folder / name).is_file()), None)


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

    It holds rgb.txt, depth.txt, or else a list of pairs (associations.txt), the images they name, and the
    calibration unless `options` do. Images without a partner within ``options.association_limit_s`` are
    dropped and counted in ``metadata["dropped"]``. Depth has 5000 units per meter unless the folder or the
    user says otherwise.

    Raises RecordingFormatError if a list is damaged, or no pair can be used; CalibrationError if there is no
    calibration, or an unusable one.

    References
    ----------
    .. [1] J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A benchmark for the evaluation of
       RGB-D SLAM systems", IROS 2012.
    """

    def __init__(self, folder: Path, options: SourceOptions) -> None:
        lists, associations = _lists(folder), _associations(folder)
        if lists is not None:
            pairs, moments, dropped = _of_lists(folder, *lists[:2], options.association_limit_s)
            convention = lists[2]
        elif associations is not None:
            pairs, moments, dropped = _of_associations(folder, associations)
            convention = _TUM
        else:
            raise RecordingFormatError(f"{folder}: has neither rgb.txt and depth.txt nor associations.txt")
        self._folder = folder.resolve()
        shots = shots_of(folder, pairs, options, convention=convention, moments_ns=moments)
        poses = poses_at(folder, moments, upward=any(shot.cameras.depth.matrix[1, 1] < 0 for shot in shots))
        shots = [
            replace(shot, pose=shot.pose if pose is None else pose @ shot.cameras.color_from_depth)
            for shot, pose in zip(shots, poses, strict=True)
        ]
        super().__init__(folder, shots, "TUM RGB-D", dropped)

    def _pair(self, index: int) -> ImagePair:
        """Return the files of a frame, which must be in the recording's folder, links resolved."""
        pair = super()._pair(index)
        for path in (pair.color or pair.depth, pair.depth):
            try:
                inside = path.resolve().is_relative_to(self._folder)
            except (OSError, ValueError, RuntimeError) as err:
                name = quoted(str(path).removeprefix(f"{self._path}/"))
                raise FrameFormatError(f"{self._path}: {name}: not the name of an image ({err})") from err
            if not inside:
                raise FrameFormatError(f"{path}: the image is outside the recording's folder; copy it there")
        return pair


def _of_lists(
    folder: Path, color_list: str, depth_list: str, limit_s: float
) -> tuple[list[ImagePair], list[int], int]:
    """Return the pairs of two lists, their times, and how many images have no partner."""
    colors, no_colors = _read_list(folder / color_list)
    depths, no_depths = _read_list(folder / depth_list)
    found = associate([ns for ns, _ in colors], [ns for ns, _ in depths], round(limit_s * 1e9))
    if not found:
        raise RecordingFormatError(
            f"{folder}: none of {len(colors)} color and {len(depths)} depth images are within {limit_s} s of "
            "each other"
        )
    if len(found) < _FOUND_MIN * min(len(colors), len(depths)):
        text = "%s: only %d of %d depth images have color within %g s (--set association_limit_s=S)"
        _log.warning(text, folder, len(found), len(depths), limit_s)
    pairs = []
    for c, d in found:
        color, depth = folder / colors[c][1], folder / depths[d][1]
        pairs.append(ImagePair(depth.stem, color, depth))
    single = len(colors) + len(depths) - 2 * len(found)
    return pairs, [depths[d][0] for _, d in found], single + no_colors + no_depths


def _of_associations(folder: Path, path: Path) -> tuple[list[ImagePair], list[int], int]:
    """Return the pairs that a list names, their times, and how many lines could not be used."""
    pairs, moments, bad = [], [], 0
    for line in _lines(path):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            stamps, names = [_moment_ns(word) for word in words[0:4:2]], [Path(word) for word in words[1:4:2]]
            # Either comes first: associate.py names color before depth, ICL-NUIM depth before color.
            depth_first = str(names[0]).casefold().count("depth") > str(names[1]).casefold().count("depth")
            color, depth = reversed(names) if depth_first else names
            pairs.append(ImagePair(depth.stem, folder / color, folder / depth))
            moments.append(stamps[0 if depth_first else 1])
        except (InvalidOperation, IndexError, ValueError):
            bad += 1
    if not pairs:
        raise RecordingFormatError(f"{path}: expected lines of 'seconds file seconds file', got none")
    if bad:
        _log.warning("%s: %d lines are skipped", path, bad)
    second = 1_000_000_000
    if all(ns % second == 0 and ns < _FRAME_NUMBERS * second for ns in moments):
        moments = [ns // second * FRAME_INTERVAL_NS for ns in moments]
    return pairs, moments, bad


def _lines(path: Path) -> list[str]:
    content = read_file(path, LIST_BYTES_MAX, what="list")
    if (kind := stand_in(content)) is not None:
        raise RecordingFormatError(f"{path}: {kind}")
    # Other programs separate by commas, or write names as Windows does.
    lines = decode_text(content, "replace").translate(str.maketrans(",\\", " /")).splitlines()
    if len(lines) > LIST_LINES_MAX:
        raise RecordingFormatError(f"{path}: expected {LIST_LINES_MAX} lines at most, got {len(lines)}")
    return lines


def _read_list(path: Path) -> tuple[list[tuple[int, str]], int]:
    """Return the times and names of a list in order of time, and how many lines could not be used."""
    lines = _lines(path)
    images: dict[int, str] = {}
    bad = repeated = 0
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
        if images.setdefault(moment_ns, name) != name:
            bad, repeated = bad + 1, repeated + 1
    if wrong and not images:
        raise RecordingFormatError(wrong)
    if wrong:
        _log.warning("%s; %d lines are skipped", wrong, bad)
    if repeated:
        _log.warning("%s: %d images have the time of another one, and are left out", path, repeated)
    listed = sorted(images.items())
    steps = [after - before for (before, _), (after, _) in itertools.pairwise(listed)]
    if steps and median(steps) > _STEP_MAX_S * 1e9 and listed[-1][0] < _SINCE_2001_S * 1e9:
        _log.warning("%s: stamps are taken for milliseconds, by the steps between them", path)
        listed = [(moment_ns // 1000, name) for moment_ns, name in listed]
    return listed, bad


def _moment_ns(word: str) -> int:
    if len(word) > _STAMP_CHARACTERS_MAX:
        raise ValueError(f"expected {_STAMP_CHARACTERS_MAX} characters at most")
    # Seconds since 1970 to the microsecond have more digits than a float keeps.
    seconds = Decimal(word)
    if seconds >= _END_S and word.replace(".", "", 1).isdecimal():
        seconds = _of_smaller_units(seconds)
    if not 0 <= seconds < _END_S:
        raise ValueError("expected seconds from 1970 to 2038")
    return int(seconds * 1_000_000_000)


def _of_smaller_units(moment: Decimal) -> Decimal:
    """Return in seconds what is too large for them: milliseconds, microseconds or nanoseconds since 1970."""
    for power in (3, 6, 9):
        seconds = moment.scaleb(-power)
        # Before 2001 a stamp of one unit could be one of the next.
        if _SINCE_2001_S <= seconds < _END_S:
            return seconds
    raise ValueError("expected a time from 1970 to 2038")
