"""Colors of labels, tree nodes and residuals, which mean the same in every frame."""

from collections import Counter
from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.vocabulary import Division, StopReason

#: Number of labels with a color of their own.
LABEL_COLORS = 1023

#: Fill of a leaf by its stop reason, and its meaning; the first four colors are the paper's (figure 3).
STOPS: dict[StopReason, tuple[tuple[int, int, int], str]] = {
    StopReason.CRITERION: ((222, 45, 38), "red: a split was tried and did not fit better"),
    StopReason.CHILD_TOO_SMALL: ((253, 141, 20), "orange: a side of the cut was smaller than T_p"),
    StopReason.TOO_SMALL: ((161, 225, 128), "light green: at most 2 T_p"),
    StopReason.DEPTH: ((26, 140, 65), "green: the tree's maximum depth T_d was reached"),
    StopReason.SPLITS: ((66, 133, 217), "blue: the maximum number of splits T_s was reached"),
    StopReason.NO_CUT: ((158, 97, 204), "violet: no cut was found"),
    StopReason.NO_FIT: ((240, 98, 180), "pink: no surface could be fitted"),
    StopReason.NO_POINTS: ((240, 240, 240), "white: no points"),
    StopReason.NOISE: ((45, 190, 200), "turquoise: so close to the sensor's noise that no split can be kept"),
    StopReason.UNTRIED: (
        (214, 196, 120),
        "sand: a protrusion, what remains beside it, or a part at a crease",
    ),
    StopReason.BUDGET: ((128, 20, 70), "maroon: the time limit for the frame (--budget-ms) was reached"),
    StopReason.PENDING: ((250, 240, 30), "yellow: it is tried in one of the next frames (live)"),
}
STOP_COLORS = {reason: color for reason, (color, _) in STOPS.items()}
#: Fill of a divided segment: gray if it was cut, otherwise darker.
DIVISION_COLORS: dict[Division, tuple[int, int, int]] = {
    Division.CUT: (150, 155, 162),
    Division.GAP: (92, 96, 102),
    Division.APPEARED: (112, 92, 82),
    Division.PROTRUSION: (82, 98, 112),
    Division.CREASE: (98, 88, 118),
}

#: Lines of a plot, in their order.
SERIES_COLORS = (
    (90, 170, 250),
    (245, 165, 60),
    (120, 210, 120),
    (235, 105, 150),
    (180, 140, 240),
    (90, 210, 205),
    (225, 215, 110),
    (200, 200, 200),
)

#: Color of a region of the ground truth that nothing overlaps.
NOTHING_COLOR = (128, 128, 128)

#: Shades of an object's color for its surfaces: share of white or, if negative, of black.
_SHADES = (0.0, 0.45, -0.35, 0.22, -0.18, 0.65, -0.5)
SHADES = len(_SHADES)

#: Names of colors, for tables that have no room for swatches.
_COLOR_NAMES = {
    "red": (230, 25, 25),
    "orange": (245, 130, 30),
    "brown": (160, 105, 45),
    "gold": (215, 165, 20),
    "yellow": (245, 230, 60),
    "olive": (140, 145, 30),
    "lime": (140, 240, 20),
    "green": (20, 150, 40),
    "sea green": (60, 160, 130),
    "turquoise": (50, 215, 205),
    "light blue": (150, 205, 250),
    "blue": (30, 115, 225),
    "violet": (140, 95, 225),
    "lilac": (200, 160, 235),
    "magenta": (240, 30, 230),
    "pink": (250, 170, 205),
    "rose": (225, 90, 140),
    "mauve": (170, 110, 140),
    "mint": (75, 255, 195),
    "sand": (225, 205, 150),
    "gray": (150, 150, 150),
}

#: Residuals from 0 to the maximum drawn: blue, cyan, green, yellow, red.
_RESIDUAL_STOPS = ((38, 70, 200), (30, 165, 200), (70, 185, 85), (245, 215, 60), (214, 32, 32))


@lru_cache(maxsize=1)
def label_colors() -> NDArray[np.uint8]:
    """Return the colors of the labels 1, 2, ..., as (LABEL_COLORS, 3) RGB.

    Each color is the one farthest, in the perceptual space OKLab, from all previous ones. So the first few,
    which most frames use, differ most, and a label's color never depends on others.

    References
    ----------
    .. [1] B. Ottosson, "A perceptual color space for image processing", 2020.
    """
    levels = np.linspace(0, 255, 18).round().astype(np.uint8)
    rgb = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    lab = _oklab(rgb)
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    # Neither so dark as the viewer's background nor so pale that a label looks unlabeled.
    usable = (lab[:, 0] > 0.58) & (lab[:, 0] < 0.90) & (chroma > 0.07)
    rgb, lab = rgb[usable], lab[usable]
    first = int(np.argmin(np.abs(rgb.astype(int) - [30, 120, 220]).sum(axis=1)))
    chosen = [first]
    nearest = np.full(len(lab), np.inf)
    for _ in range(LABEL_COLORS - 1):
        np.minimum(nearest, ((lab - lab[chosen[-1]]) ** 2).sum(axis=1), out=nearest)
        chosen.append(int(np.argmax(nearest)))
    colors: NDArray[np.uint8] = rgb[chosen]
    colors.flags.writeable = False
    return colors


def shades_of_surfaces(object_of_surface: Mapping[int, int]) -> dict[int, tuple[int, int]]:
    """Return each surface's object and its shade of that color; the lowest label has 0, the color itself."""
    shades: dict[int, tuple[int, int]] = {}
    surfaces = Counter[int]()
    for surface, thing in sorted(object_of_surface.items()):
        shades[surface] = thing, surfaces[thing] % SHADES
        surfaces[thing] += 1
    return shades


def shaded(label: int, shade: int) -> tuple[int, int, int]:
    """Return a shade of a label's color, RGB."""
    share = _SHADES[shade]
    red, green, blue = (
        round(each + share * (255 - each) if share > 0 else (1.0 + share) * each)
        for each in label_color(label)
    )
    return red, green, blue


def label_color(label: int) -> tuple[int, int, int]:
    """Return the RGB color of a label; the first `LABEL_COLORS` differ."""
    red, green, blue = label_colors()[(label - 1) % LABEL_COLORS].tolist()
    return red, green, blue


def paler(labels: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Return the colors of labels, (N,), half way to white, as a text needs on a photo: (N, 3) RGB."""
    return np.asarray(label_colors()[(labels.astype(int) - 1) % LABEL_COLORS] // 2 + 128, dtype=np.uint8)


@lru_cache(maxsize=LABEL_COLORS)
def color_name(label: int) -> str:
    """Return the name of a label's color."""
    named = _oklab(np.array([*_COLOR_NAMES.values()], dtype=np.uint8))
    distances = np.linalg.norm(named - _oklab(np.array([label_color(label)], dtype=np.uint8)), axis=1)
    return [*_COLOR_NAMES][int(np.argmin(distances))]


def packed(colors: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return colors, (N, 3) RGB, as Rerun's (N,) numbers 0xRRGGBBAA."""
    red, green, blue = colors.astype(np.uint32).T
    return np.asarray(red << 24 | green << 16 | blue << 8 | np.uint32(255), dtype=np.uint32)


def residual_colors(residuals_m: NDArray[np.floating], residual_max_m: float) -> NDArray[np.uint32]:
    """Return the `packed` color of each residual: blue for 0, through green, to red for `residual_max_m`."""
    index = np.clip(residuals_m / residual_max_m * 255.0, 0.0, 255.0).astype(np.uint8)
    colors: NDArray[np.uint32] = _residual_table()[index]
    return colors


@lru_cache(maxsize=1)
def _residual_table() -> NDArray[np.uint32]:
    at = np.linspace(0, len(_RESIDUAL_STOPS) - 1, 256)
    stops = np.array(_RESIDUAL_STOPS, dtype=float)
    channels = [np.interp(at, np.arange(len(stops)), stops[:, channel]) for channel in range(3)]
    return packed(np.stack(channels, axis=-1).round().astype(np.uint8))


def _oklab(rgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Convert (N, 3) sRGB to OKLab."""
    encoded = rgb / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    lms_from_rgb = np.array(
        [
            [0.4122214708, 0.5363325363, 0.0514459929],
            [0.2119034982, 0.6806995451, 0.1073969566],
            [0.0883024619, 0.2817188376, 0.6299787005],
        ]
    )
    lab_from_lms = np.array(
        [
            [0.2104542553, 0.7936177850, -0.0040720468],
            [1.9779984951, -2.4285922050, 0.4505937099],
            [0.0259040371, 0.7827717662, -0.8086757660],
        ]
    )
    lab: NDArray[np.float64] = np.cbrt(linear @ lms_from_rgb.T) @ lab_from_lms.T
    return lab
