"""Finds the pairs of color and depth images in a folder by how people name them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from nurbseg.drivers.datasets.sequence import natural_key
from nurbseg.drivers.errors import RecordingFormatError

_ROLES = {"color": "color", "rgb": "color", "depth": "depth", "label": "labels", "labels": "labels"}
_WORDS = "|".join(sorted(_ROLES, key=len, reverse=True))
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
    "NAME_color.png|jpg with NAME_depth.png, frame-000001.color.jpg with frame-000001.depth.png, "
    "rgb_0.png with depth_0.png, or the folders color (or rgb) and depth"
)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """The files of one frame.

    Parameters
    ----------
    name : str
        What the names have in common; may be empty.
    color, depth : Path
        The two images.
    labels : Path or None
        Ground truth, where there is one.
    """

    name: str
    color: Path
    depth: Path
    labels: Path | None = None


def find_pairs(folder: Path) -> tuple[list[ImagePair], list[Path]]:
    """Find the pairs in a folder.

    Parameters
    ----------
    folder : Path
        Holds the images themselves, or the folders ``color`` (or ``rgb``), ``depth`` and ``label``, whose
        images are paired by name.

    Returns
    -------
    pairs : list of ImagePair
        In natural order of their names.
    single : list of Path
        Color and depth images that lack the other.

    Raises
    ------
    RecordingFormatError
        If two files claim the same place.
    """
    found: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            role = _ROLES.get(path.name.casefold())
            if role is None:
                continue
            for image in sorted(path.iterdir()):
                _enter(found, image.stem, role, image)
        else:
            key, role = key_and_role(path.stem)
            if role is not None:
                _enter(found, key, role, path)
    pairs, single = [], []
    for key in sorted(found, key=natural_key):
        files = found[key]
        if "color" in files and "depth" in files:
            pairs.append(ImagePair(key, files["color"], files["depth"], files.get("labels")))
        else:
            single += [files[role] for role in ("color", "depth") if role in files]
    return pairs, single


def key_and_role(stem: str) -> tuple[str, str | None]:
    """Return what a pair's names have in common and which image this is: color, depth, labels or None."""
    match = _ROLE_LAST.fullmatch(stem) or _ROLE_FIRST.fullmatch(stem)
    if match is None:
        return "", None
    return match["key"] or "", _ROLES[match["role"].casefold()]


def _enter(found: dict[str, dict[str, Path]], key: str, role: str, path: Path) -> None:
    if path.suffix.lower().lstrip(".") not in _EXTENSIONS[role] or path.name.startswith("."):
        return
    files = found.setdefault(key, {})
    if role in files:
        raise RecordingFormatError(f"{path}: {files[role].name} is the {role} image of {key!r} already")
    files[role] = path
