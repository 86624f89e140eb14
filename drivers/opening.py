"""Opens a source of frames in this process, from what a user names: a URI or a path.

The modules of the formats are imported on use, so that what one of them needs is not needed by the others.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.common.errors import DeviceNotFoundError, DriverError, RecordingFormatError
from nurbseg.common.files import (
    MCAP_MAGIC,
    ONI_MAGIC,
    ROSBAG_MAGIC,
    SQLITE_MAGIC,
    open_regular,
    visible,
    with_suffix,
)
from nurbseg.drivers.options import SourceOptions

if TYPE_CHECKING:
    from nurbseg.drivers.source import FrameSource

#: Schemes of cameras, each with the class of its cameras.
CAMERAS = {"openni2": "openni2.device:DeviceSource", "realsense": "realsense.device:RealSenseSource"}
#: URI schemes.
SCHEMES = (*CAMERAS, "images")

_ONI = "openni2.oni.playback:OniSource"
_FORMATS = "an MCAP recording, a bag of ROS (.db3, .bag) or an OpenNI2 recording (.oni)"
#: Of recordings that are one file, if a folder holds nothing else.
_SUFFIXES = (".mcap", ".db3", ".bag", ".oni")
_FOLDERS = "rgb.txt and depth.txt (TUM), one recording, or pairs of images"


def open_here(
    uri: str | Path, options: SourceOptions, open_foreign: Callable[..., FrameSource] | None = None
) -> FrameSource:
    """Open a camera or a recording that this process reads; parameters and errors as of `open_source`.

    Cameras and sources of other packages are opened by `open_foreign`, which is called with the name of a
    class or function, ``module:name`` in this package, and its arguments.
    """
    open_foreign = open_foreign or _open_with
    if not isinstance(uri, str | Path):
        raise TypeError(f"uri: expected a path, or a camera such as 'openni2:', got {uri!r}")
    scheme, separator, rest = str(uri).partition(":")
    if separator and scheme == "images":
        return _open_with("datasets.folders:open_patterns", rest, options)
    if separator and scheme == "openni2" and rest.lower().endswith(".oni"):
        return _open_with(_ONI, Path(rest), options)
    if separator and scheme in CAMERAS:
        return open_foreign(CAMERAS[scheme], rest, options.device, options.association_limit_s)
    path = Path(uri)
    try:
        if not path.exists():
            from nurbseg.drivers.plugins import registered_schemes

            others = registered_schemes()
            if separator and scheme in others:
                return open_foreign("plugins:open_registered", others[scheme], rest, options)
            schemes = " or ".join(f"{name}:" for name in dict.fromkeys((*SCHEMES, *others)))
            raise DeviceNotFoundError(f"{path}: no such file or folder (a URI starts with {schemes})")
        return _open_folder(path, options) if path.is_dir() else _open_file(path, options)
    except OSError as err:
        if isinstance(err, DriverError):
            raise
        raise RecordingFormatError(f"{path}: the recording cannot be read ({err.strerror})") from err


def _open_file(path: Path, options: SourceOptions) -> FrameSource:
    from nurbseg.drivers.calibration.foreign import HEAD_BYTES, what_it_is

    with open_regular(path) as stream:
        head = stream.read(HEAD_BYTES).removeprefix(b"\xef\xbb\xbf")
    if head.startswith((MCAP_MAGIC, ROSBAG_MAGIC, SQLITE_MAGIC)):
        return _open_with("mcap.reader:RecordingReader", path, options)
    if head.startswith(ONI_MAGIC):
        return _open_with(_ONI, path, options)
    if not head:
        raise RecordingFormatError(f"{path}: the file is empty; expected {_FORMATS}")
    if (kind := what_it_is(head, path)) is not None:
        raise RecordingFormatError(f"{path}: cannot be replayed: {kind}")
    raise RecordingFormatError(f"{path}: not a recording of a known format; expected {_FORMATS}")


def _open_folder(path: Path, options: SourceOptions) -> FrameSource:
    from nurbseg.drivers.calibration.foreign import HEAD_BYTES, is_image, what_it_is
    from nurbseg.drivers.datasets.folders import open_folder, scene_folders
    from nurbseg.drivers.datasets.pairs import NAMES_EXPECTED, find_pairs
    from nurbseg.drivers.datasets.tum import TumSource, is_tum

    if is_tum(path):
        return TumSource(path, options)
    pairs, single = find_pairs(path)
    if pairs or scene_folders(path):
        return open_folder(path, options)
    if visible(path, "*.mcap*") or visible(path, "*.db3*"):
        from nurbseg.drivers.mcap.container.parts import parts_in

        if parts_in(path):
            return _open_with("mcap.reader:RecordingReader", path, options)
    recordings = sorted(file for suffix in _SUFFIXES for file in with_suffix(path, suffix))
    if len(recordings) == 1:
        # A bag of ROS 2 is a folder with one file.
        return _open_file(recordings[0], options)
    if single:
        # Says which names are expected.
        return open_folder(path, options)
    if recordings:
        raise RecordingFormatError(f"{path}: holds {len(recordings)} recordings; name one of them")
    for file in (file for file in visible(path) if file.is_file()):
        with open_regular(file) as stream:
            head = stream.read(HEAD_BYTES)
        # Images are fine but for their names.
        kind = None if is_image(head) else what_it_is(head, file)
        if kind is not None:
            raise RecordingFormatError(f"{file}: cannot be replayed: {kind}")
    found = "is empty" if not visible(path) else "contains nothing that can be replayed"
    raise RecordingFormatError(f"{path}: the folder {found}; expected {_FOLDERS}: {NAMES_EXPECTED}")


def _open_with(name: str, *arguments: object) -> FrameSource:
    """Call a function or class, ``module:name`` in this package."""
    module, _, opener = name.partition(":")
    source: FrameSource = getattr(import_module(f"nurbseg.drivers.{module}"), opener)(*arguments)
    return source
