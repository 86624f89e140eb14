"""Recordings of libfreenect's own recorder, which are those of the raw NYU Depth v2 set too."""

import logging
import re
from pathlib import Path

from nurbseg.common.errors import RecordingFormatError
from nurbseg.drivers.datasets.folders import PairSource, shots_of
from nurbseg.drivers.datasets.listed.tum import associate
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

#: d-1316653580.471513-2118112269.pgm: the kind, the host's time in seconds, and the Kinect's own.
_NAME = re.compile(r"([dr])-(\d{1,10})\.(\d{6})-\d+\.(?:pgm|ppm)")
_DISPARITY = DepthUnit(1000.0, "libfreenect's raw values, by the constants of NYU Depth v2", "disparity")
#: Images of 30 Hz that were taken together are not farther apart, seconds.
_LIMIT_S = 0.034


def open_freenect(folder: Path, options: SourceOptions) -> PairSource:
    """Open a recording: raw disparities of the infrared camera, paired with color by the host's time.

    Raises RecordingFormatError if no two images belong together; CalibrationError if there is no calibration.
    """
    images: dict[str, list[tuple[int, Path]]] = {"d": [], "r": []}
    for path in folder.iterdir():
        if (match := _NAME.fullmatch(path.name)) is not None:
            images[match[1]].append((int(match[2]) * 1_000_000_000 + int(match[3]) * 1000, path))
    colors, depths = sorted(images["r"]), sorted(images["d"])
    limit_ns = round(max(options.association_limit_s, _LIMIT_S) * 1e9)
    found = associate([ns for ns, _ in colors], [ns for ns, _ in depths], limit_ns)
    if not found:
        raise RecordingFormatError(f"{folder}: no d-*.pgm and r-*.ppm were taken at the same time")
    pairs = [ImagePair(depths[d][1].stem, colors[c][1], depths[d][1]) for c, d in found]
    moments = [depths[d][0] for _, d in found]
    shots = shots_of(folder, pairs, options, convention=_DISPARITY, moments_ns=moments)
    if shots[0].cameras.depth is shots[0].cameras.color:
        _log.warning(
            "%s: libfreenect's depth is not registered to color, but the calibration is of one camera: give "
            "that of both by --calibration",
            folder,
        )
    single = len(colors) + len(depths) - 2 * len(found)
    return PairSource(folder, shots, "libfreenect's recorder", dropped=single)
