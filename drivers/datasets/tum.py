"""Recordings in the layout of the TUM RGB-D benchmark: rgb.txt and depth.txt list images by time."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.drivers.datasets.folders import first_calibration, folder_camera, load_pair
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.datasets.sequence import SequenceSource
from nurbseg.drivers.errors import RecordingFormatError
from nurbseg.drivers.frame import RGBDFrame

if TYPE_CHECKING:
    from nurbseg.drivers.options import SourceOptions

_UNITS_PER_METRE = 5000.0
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
    start = 0
    for place, moment in enumerate(first_ns):
        while start < len(second_ns) and second_ns[start] < moment - limit_ns:
            start += 1
        other = start
        while other < len(second_ns) and second_ns[other] <= moment + limit_ns:
            near.append((abs(second_ns[other] - moment), place, other))
            other += 1
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
        colors, depths = _read_list(folder / COLOR_LIST), _read_list(folder / DEPTH_LIST)
        limit_ns = round(options.association_limit_s * 1e9)
        found = associate([ns for ns, _ in colors], [ns for ns, _ in depths], limit_ns)
        if not found:
            raise RecordingFormatError(
                f"{folder}: none of {len(colors)} color and {len(depths)} depth images are within "
                f"{options.association_limit_s} s of each other"
            )
        self._reading = folder_camera(folder, options, _UNITS_PER_METRE)
        super().__init__(folder, len(found), dropped=len(colors) + len(depths) - 2 * len(found))
        self._pairs = [ImagePair(depths[d][1].stem, colors[c][1], depths[d][1]) for c, d in found]
        self._moments_ns = [depths[d][0] for _, d in found]
        self.calibration = first_calibration(self._pairs, self._reading)
        self.metadata = {
            "format": "TUM RGB-D",
            "frames": str(len(found)),
            "dropped": str(self.dropped),
            "calibration": self._reading.origin,
        }

    def _load(self, index: int) -> RGBDFrame:
        return load_pair(self._pairs[index], self._reading, index, self._moments_ns[index])


def _read_list(path: Path) -> list[tuple[int, Path]]:
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise RecordingFormatError(f"{path}: the list cannot be read ({err})") from err
    images = []
    for place, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            # Seconds since 1970 to the microsecond have more digits than a float keeps.
            moment_ns = int(Decimal(words[0]) * 1_000_000_000)
            name = words[1]
        except (InvalidOperation, IndexError, ValueError, OverflowError) as err:
            raise RecordingFormatError(
                f"{path}: line {place}: expected 'seconds file', got {line!r}"
            ) from err
        images.append((moment_ns, path.parent / name))
    return sorted(images)
