"""Finds the pairs of color and depth images in a folder by their usual names."""

import glob
import logging
import re
from dataclasses import dataclass
from pathlib import Path

from nurbseg.drivers.datasets.sequence import natural_key
from nurbseg.drivers.errors import RecordingFormatError

_log = logging.getLogger(__name__)

_ROLES = {"color": "color", "rgb": "color", "depth": "depth", "label": "labels", "labels": "labels"}
#: Words that count only if no better one names an image of the same frame.
_WEAK_ROLES = {"d": "depth", "image": "color", "images": "color"}
_ALL_ROLES = _ROLES | _WEAK_ROLES
_WORDS = "|".join(sorted(_ALL_ROLES, key=len, reverse=True))
_EXTENSIONS = {
    "color": ("png", "jpg", "jpeg", "ppm", "tif", "tiff", "bmp"),
    "depth": ("png", "pgm", "tif", "tiff"),
    "labels": ("png", "pgm", "tif", "tiff"),
}
#: NAME_color.png, frame-000001.color.jpg
_ROLE_LAST = re.compile(rf"(?P<key>.+)[_.-](?P<role>{_WORDS})", re.IGNORECASE)
#: rgb_0.png, rgb.png
_ROLE_FIRST = re.compile(rf"(?P<role>{_WORDS})(?:[_.-](?P<key>.+))?", re.IGNORECASE)

NAMES_EXPECTED = (
    "NAME_color.png|jpg (or _rgb, _image) with NAME_depth.png (or _d), frame-000001.color.jpg with "
    "frame-000001.depth.png, rgb_0.png with depth_0.png, or the folders color (or rgb, image) and depth; "
    "images of any other names by two patterns, --color 'GLOB' --depth 'GLOB'"
)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """The files of one frame; its name is what theirs have in common, and may be empty."""

    name: str
    color: Path
    depth: Path
    labels: Path | None = None


def find_pairs(folder: Path) -> tuple[list[ImagePair], list[Path]]:
    """Find the pairs in a folder, in natural order of their names, and images that lack their partner.

    The folder holds the images themselves, or the folders ``color`` (or ``rgb``, ``image``), ``depth`` and
    ``label``, whose images are paired by name. Raises RecordingFormatError if two files claim the same place.
    """
    named: list[tuple[bool, Path, str, str]] = []
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            word = path.name.casefold()
            if word in _ALL_ROLES:
                role = _ALL_ROLES[word]
                named += [(word in _WEAK_ROLES, image, image.stem, role) for image in path.iterdir()]
        elif (parts := key_and_word(path.stem)) is not None:
            key, word = parts
            named.append((word in _WEAK_ROLES, path, key, _ALL_ROLES[word]))
    found: dict[str, dict[str, Path]] = {}
    for weak, path, key, role in sorted(named):
        if path.suffix.lower().lstrip(".") not in _EXTENSIONS[role] or path.name.startswith("."):
            continue
        files = found.setdefault(key, {})
        if role not in files:
            files[role] = path
        elif not weak:
            raise RecordingFormatError(f"{path}: {files[role].name} is already the {role} image of {key!r}")
    pairs, single = [], []
    for key in sorted(found, key=natural_key):
        files = found[key]
        if "color" in files and "depth" in files:
            pairs.append(ImagePair(key, files["color"], files["depth"], files.get("labels")))
        else:
            single += [files[role] for role in ("color", "depth") if role in files]
    return pairs, single


def key_and_word(stem: str) -> tuple[str, str] | None:
    """Return what a pair's names have in common, and the word that says which image this is."""
    match = _ROLE_LAST.fullmatch(stem) or _ROLE_FIRST.fullmatch(stem)
    return match and (match["key"] or "", match["role"].casefold())


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
