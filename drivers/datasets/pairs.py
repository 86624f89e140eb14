"""Finds the pairs of color and depth images in a folder by their usual names."""

import glob
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.files import visible
from nurbseg.drivers.calibration.foreign import by_name
from nurbseg.drivers.datasets.sequence import natural_key

_log = logging.getLogger(__name__)

_ROLES = {
    "color": "color",
    "colour": "color",
    "rgb": "color",
    "depth": "depth",
    "label": "labels",
    "labels": "labels",
}
_EXTENSIONS = {
    "color": ("png", "jpg", "jpeg", "ppm", "tif", "tiff", "bmp", "npy"),
    "depth": ("png", "pgm", "tif", "tiff", "npy"),
    "labels": ("png", "pgm", "tif", "tiff"),
}
_WORDS = "|".join(_ROLES)
#: NAME_color.png, frame-000001.color.jpg
_ROLE_LAST = re.compile(rf"(?P<key>.+?)[_.-](?P<role>{_WORDS})", re.IGNORECASE | re.DOTALL)
#: rgb_0.png, rgb.png
_ROLE_FIRST = re.compile(rf"(?P<role>{_WORDS})(?:[_.-](?P<key>.+))?", re.IGNORECASE | re.DOTALL)

NAMES_EXPECTED = (
    "NAME_color.png|jpg (or _rgb) with NAME_depth.png, frame-000001.color.jpg with frame-000001.depth.png, "
    "rgb_0.png with depth_0.png, or the folders color (or rgb) and depth; images of any other names by two "
    "patterns, --color 'GLOB' --depth 'GLOB'"
)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """The files of one frame; its name is what theirs have in common, and may be empty.

    `color` is None where a folder has none at all.
    """

    name: str
    color: Path | None
    depth: Path
    labels: Path | None = None


def find_pairs(folder: Path) -> tuple[list[ImagePair], list[Path]]:
    """Find the pairs in a folder, in natural order of their names, and images that lack their partner.

    The folder holds the images themselves, or the folders ``color`` (or ``rgb``), ``depth`` and ``label``,
    whose images are paired by name. Where there are depth images alone, each is a pair without color. Those
    that lack their partner include files of depth that cannot be read. Raises RecordingFormatError if two
    files claim the same place.
    """
    found: dict[str, dict[str, Path]] = {}
    single: list[Path] = []
    for path, key, role in _named(folder):
        files = found.setdefault(key, {})
        if path.suffix.lower().lstrip(".") not in _EXTENSIONS[role]:
            if role == "depth" and by_name(path) is not None:
                single.append(path)
        elif role in files:
            raise RecordingFormatError(f"{path}: {files[role].name} is already the {role} image of {key!r}")
        else:
            files[role] = path
    alone = not any("color" in files for files in found.values())
    pairs = []
    for key in sorted(found, key=natural_key):
        files = found[key]
        if "depth" in files and ("color" in files or alone):
            pairs.append(ImagePair(key, files.get("color"), files["depth"], files.get("labels")))
        else:
            images = [files[role] for role in ("color", "depth") if role in files]
            single += images or files.values()
    return pairs, single


def _named(folder: Path) -> Iterator[tuple[Path, str, str]]:
    """Yield the files of a folder that are called like images of a pair, with their key and role."""
    for path in visible(folder):
        if not path.is_dir():
            parts = key_and_role(path.stem)
            if parts is not None:
                yield path, *parts
        elif (role := _ROLES.get(path.name.casefold())) is not None:
            for image in visible(path):
                # The names may repeat the folder's.
                parts = key_and_role(image.stem)
                yield image, parts[0] if parts is not None and parts[1] == role else image.stem, role


def is_depth(path: Path) -> bool:
    """Whether an image is one of depth, by its own or its folder's name."""
    parts = key_and_role(path.stem)
    return (parts[1] if parts is not None else _ROLES.get(path.parent.name.casefold())) == "depth"


def key_and_role(stem: str) -> tuple[str, str] | None:
    """Return what a pair's names have in common, and which of its images this is."""
    match = _ROLE_LAST.fullmatch(stem) or _ROLE_FIRST.fullmatch(stem)
    return match and (match["key"] or "", _ROLES[match["role"].casefold()])


def match_patterns(color: str, depth: str) -> tuple[list[ImagePair], int]:
    """Pair the files that match two shell patterns, by the text that matches the wildcards.

    Returns the pairs in natural order, each named as its color image, and the number of images that lack
    their partner. If no two names have the same text there, but there are as many color as depth images, they
    are paired in natural order. Raises RecordingFormatError if a pattern matches nothing, two files of one
    are alike, or the files cannot be paired.
    """
    colors, depths = _by_wildcards(color), _by_wildcards(depth)
    keys = sorted(colors.keys() & depths.keys())
    matched = [(colors[key], depths[key]) for key in keys]
    if not matched:
        if len(colors) != len(depths):
            raise RecordingFormatError(
                f"{color}, {depth}: {len(colors)} color and {len(depths)} depth images, whose names have "
                "nothing in common at the wildcards, so they cannot be paired"
            )
        _log.warning("%s, %s: names have nothing in common; paired in order", color, depth)
        matched = [(colors[a], depths[b]) for a, b in zip(sorted(colors), sorted(depths), strict=True)]
    pairs = [ImagePair(each.stem, each, partner) for each, partner in matched]
    return pairs, len(colors) + len(depths) - 2 * len(pairs)


def _by_wildcards(pattern: str) -> dict[tuple[tuple[int, str], ...], Path]:
    """Return the files that match a pattern, by the text that matches its wildcards."""
    found: dict[tuple[tuple[int, str], ...], Path] = {}
    fixed = re.split(r"[*?]|\[[^]]*\]", pattern)
    for name in sorted(glob.glob(pattern, recursive=True)):  # noqa: PTH207 (patterns may be absolute)
        if not Path(name).is_file():
            continue
        key = natural_key(name[len(fixed[0]) : len(name) - len(fixed[-1])] if len(fixed) > 1 else "")
        if key in found:
            raise RecordingFormatError(f"{name}: matches the wildcards with the same text as {found[key]}")
        found[key] = Path(name)
    if not found:
        raise RecordingFormatError(f"{pattern}: no file matches this pattern")
    return found
