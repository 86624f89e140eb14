"""Finds the pairs of color and depth images in a folder by their usual names."""

import glob
import logging
import re
from dataclasses import dataclass
from pathlib import Path

from nurbseg.common.errors import RecordingFormatError
from nurbseg.drivers.calibration.foreign import by_name
from nurbseg.drivers.datasets.sequence import natural_key

_log = logging.getLogger(__name__)

#: Depth on color's pixels: where there is any, other depth does not count.
_ALIGNED = (
    "aligned_depth",
    "depth_aligned",
    "registered_depth",
    "depth_registered",
    "aligned_depth_to_color",
)
_ROLES = {
    "color": "color",
    "colour": "color",
    "rgb": "color",
    "depth": "depth",
    "instance": "labels",
    "instance-filt": "labels",
} | dict.fromkeys(_ALIGNED, "depth")
#: Words that count only if no better one names an image of the same frame.
_WEAK_ROLES = {
    "d": "depth",
    "image": "color",
    "images": "color",
    "gray": "color",
    "frame": "color",
    "label": "labels",
    "labels": "labels",
    "label-filt": "labels",
}
_ALL_ROLES = _ROLES | _WEAK_ROLES
_WORDS = "|".join(sorted(_ALL_ROLES.keys() - {"frame"}, key=len, reverse=True))
_EXTENSIONS = {
    "color": ("png", "jpg", "jpeg", "ppm", "tif", "tiff", "bmp", "npy"),
    "depth": ("png", "pgm", "tif", "tiff", "npy"),
    "labels": ("png", "pgm", "tif", "tiff"),
}
#: NAME_color.png, frame-000001.color.jpg
_ROLE_LAST = re.compile(rf"(?P<key>.+?)[_.-](?P<role>{_WORDS})", re.IGNORECASE | re.DOTALL)
#: rgb_0.png, rgb.png
_ROLE_FIRST = re.compile(rf"(?P<role>{_WORDS})(?:[_.-](?P<key>.+))?", re.IGNORECASE | re.DOTALL)
#: depth000000.png with frame000000.jpg, image00001.png
_ROLE_NUMBER = re.compile(r"(?P<role>depth|frame|image|rgb|color)(?P<key>\d+)", re.IGNORECASE)
#: 0000012-000000400000.png: the number of a frame and its own time, as in Redwood's recordings.
_NUMBER_TIME = re.compile(r"(\d+)-\d+")

_VIDEOS = (".mp4", ".mkv", ".avi")

NAMES_EXPECTED = (
    "NAME_color.png|jpg (or _rgb, _image) with NAME_depth.png (or _d), frame-000001.color.jpg with "
    "frame-000001.depth.png, rgb_0.png with depth_0.png, or the folders color (or rgb, image) and depth; "
    "images of any other names by two patterns, --color 'GLOB' --depth 'GLOB'"
)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """The files of one frame; its name is what theirs have in common, and may be empty.

    `color` is None where a folder has none at all. `labels` is one image, or several masks with the label of
    each.
    """

    name: str
    color: Path | None
    depth: Path
    labels: Path | tuple[tuple[int, Path], ...] | None = None


def find_pairs(folder: Path) -> tuple[list[ImagePair], list[Path]]:
    """Find the pairs in a folder, in natural order of their names, and images that lack their partner.

    The folder holds the images themselves, or the folders ``color`` (or ``rgb``, ``image``), ``depth`` and
    ``label``, whose images are paired by name. Where there are depth images alone, each is a pair without
    color. Those that lack their partner include files of depth, and videos of color, that cannot be read.
    Raises RecordingFormatError if two files claim the same place.
    """
    named: list[tuple[bool, Path, str, str]] = []
    plain: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            word = path.name.casefold()
            if word in _ALL_ROLES:
                role = _ALL_ROLES[word]
                images = [each for each in path.iterdir() if not each.name.startswith(".")]
                named += [(word in _WEAK_ROLES, image, image.stem, role) for image in images]
        elif (parts := key_and_word(path.stem)) is not None:
            key, word = parts
            named.append((word in _WEAK_ROLES, path, key, _ALL_ROLES[word]))
        elif _is_readable(path, "color"):
            plain[path.stem] = path
    if any(is_aligned(path) for _, path, _, _ in named):
        named = [each for each in named if each[3] != "depth" or is_aligned(each[1])]
    named.sort()
    pairs, single = _paired(named, plain)
    whole = _complete(pairs)
    if single or not whole[0]:
        # The names in folders may repeat the folder's, or have a time of their own: the same only at first.
        bare = [(weak, path, _bare(path, key, role), role) for weak, path, key, role in named]
        if not whole[0] or len({(key, role) for _, _, key, role in bare}) == len(bare):
            again, alone = _paired(bare, plain)
            if _complete(again) > whole:
                return again, alone
    return pairs, single


def _paired(
    named: list[tuple[bool, Path, str, str]], plain: dict[str, Path]
) -> tuple[list[ImagePair], list[Path]]:
    """Pair files by their keys; a depth image without color takes the one that is called like its key."""
    found: dict[str, dict[str, Path]] = {}
    unreadable: dict[tuple[str, str], Path] = {}
    for weak, path, key, role in named:
        if path.name.startswith("."):
            continue
        if not _is_readable(path, role):
            if role == "depth" or path.suffix.lower() in _VIDEOS:
                unreadable.setdefault((key, role), path)
            continue
        files = found.setdefault(key, {})
        if role not in files:
            files[role] = path
        elif not weak:
            raise RecordingFormatError(f"{path}: {files[role].name} is already the {role} image of {key!r}")
    for key, files in found.items():
        if "depth" in files and "color" not in files and key in plain:
            files["color"] = plain[key]
    single = [
        path
        for (key, role), path in unreadable.items()
        if by_name(path) is not None and role not in found.get(key, {})
    ]
    alone = not any("color" in files for files in found.values())
    pairs = []
    for key in sorted(found, key=natural_key):
        files = found[key]
        if "depth" in files and ("color" in files or alone):
            pairs.append(ImagePair(key, files.get("color"), files["depth"], files.get("labels")))
        else:
            of_frame = [files[role] for role in ("color", "depth") if role in files]
            single += of_frame or [files["labels"]]
    if alone and pairs:
        # They may be the color that is missing.
        single += plain.values()
    return pairs, single


def _complete(pairs: list[ImagePair]) -> tuple[int, int]:
    """Return how many pairs have color, and how many have labels."""
    return sum(pair.color is not None for pair in pairs), sum(pair.labels is not None for pair in pairs)


def _is_readable(path: Path, role: str) -> bool:
    return path.suffix.lower().lstrip(".") in _EXTENSIONS[role]


def why_unreadable(path: Path) -> str | None:
    """Return what an image is that cannot be read in its role, and how it is converted; None if it can."""
    parts = key_and_word(path.stem)
    role = _ALL_ROLES.get(path.parent.name.casefold() if parts is None else parts[1])
    return None if role is None or _is_readable(path, role) else by_name(path)


def is_aligned(path: Path) -> bool:
    """Whether an image of depth is on color's pixels, by its own or its folder's name."""
    parts = key_and_word(path.stem)
    return path.parent.name.casefold() in _ALIGNED or (parts is not None and parts[1] in _ALIGNED)


def _bare(path: Path, key: str, role: str) -> str:
    """Return the key of a file without the word of its own role, and without a time."""
    parts = key_and_word(path.stem)
    if parts is not None and parts[0] and _ALL_ROLES[parts[1]] == role:
        key = parts[0]
    match = _NUMBER_TIME.fullmatch(key)
    return match[1] if match else key


def key_and_word(stem: str) -> tuple[str, str] | None:
    """Return what a pair's names have in common, and the word that says which image this is."""
    if stem.casefold() in _ROLES:
        return "", stem.casefold()
    match = next(
        (found for form in (_ROLE_LAST, _ROLE_FIRST, _ROLE_NUMBER) if (found := form.fullmatch(stem))), None
    )
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
