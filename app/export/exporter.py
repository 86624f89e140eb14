"""Writes the files of each frame's result, and of the settings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nurbseg.app.export.objects import ObjectTable
from nurbseg.app.settings.export_config import ExportConfig
from nurbseg.common.files import create_folder, write_atomically
from nurbseg.common.frame import Calibration
from nurbseg.common.json_file import read_json, write_json
from nurbseg.drivers.calibration.cameras import calibration_table
from nurbseg.library.models.forms import missing_library
from nurbseg.segmentation.config import TRIALS_MAX, DepthConfig, SegmentationConfig

if TYPE_CHECKING:
    from nurbseg.library.result import FrameResult

#: The file with the settings of all frames of an export.
SETTINGS_FILE = "settings.json"
#: The table of the objects of all frames.
OBJECTS_FILE = "objects.csv"
_OBJECTS_SUFFIX = "_objects.json"
#: Characters of the differences from other settings: the file may hold anything.
_DIFFERENCES_MOST = 2000


class ExportError(Exception):
    """A result cannot be written; the message says where and why."""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """The settings of all frames of an export."""

    config: SegmentationConfig
    source: str = ""
    #: Whether a frame continues the previous one.
    temporal: bool = False
    #: Rate that is maintained by a coarser grid, 1/s; 0 if the grid is always that of `config`.
    target_fps: float = 0.0
    surfaces: bool = False
    depth: DepthConfig = field(default_factory=DepthConfig)
    #: The cameras, if known.
    camera: Calibration | None = None
    #: Of the depth images, units per meter, if the user gave one.
    depth_scale: float | None = None
    #: Version of the program and computer that segmented all frames, on which rounding depends; empty if
    #: unknown or several. Other settings must agree within a folder, this one need not.
    computer: str = ""
    #: Leaves of the live tree that were tried in one frame; 0 for no limit.
    trials_max: int = TRIALS_MAX

    @property
    def independent(self) -> bool:
        """Whether the tree of each frame is grown independently of other frames."""
        return not (self.temporal and self.config.method == "nurbseg")

    def document(self) -> dict[str, Any]:
        """Return the content of ``settings.json``."""
        found = asdict(replace(self, camera=None))
        camera = self.camera and calibration_table(self.camera)
        return found | {"camera": camera, "segmentation": found.pop("config")}


def check_libraries(export: ExportConfig) -> None:
    """Raise ExportError if a format needs a missing library."""
    if export.cad is not None and (missing := missing_library(export.cad)):
        raise ExportError(f"--export-cad {export.cad}: {missing}")


class Exporter:
    """Writes results to a folder, which is created if needed; see docs/files.md.

    A frame's tree is written last: if it exists, the frame's other files do. The `surfaces`
    of `settings` overrides that of `export`. `written` counts frames.

    Raises ExportError if a format needs a missing library, or the folder cannot be created or contains
    results with other settings.
    """

    def __init__(self, directory: Path, settings: RunSettings, export: ExportConfig | None = None) -> None:
        self.directory = directory
        self.written = 0
        self.export = replace(export or ExportConfig(), surfaces=settings.surfaces)
        self._metric = settings.config.metric
        self._table = ObjectTable(directory / OBJECTS_FILE)
        #: Names of the trees, if frames have the names of their source.
        self._trees: set[str] = set()
        check_libraries(self.export)
        try:
            create_folder(directory)
        except ValueError as err:
            raise ExportError(str(err)) from err
        if refuse_other_results(directory, settings) not in (None, settings.computer):
            settings = replace(settings, computer="")
        try:
            write_json(directory / SETTINGS_FILE, settings.document())
        except OSError as err:
            raise ExportError(f"{directory / SETTINGS_FILE}: cannot be written: {err.strerror}") from err

    def write(self, result: FrameResult) -> None:
        """Write the files of one frame; raises as `write_files` does."""
        # Late: a process that only writes files need not load the segmentation.
        from nurbseg.app.export.frame_files import frame_files

        self.write_files(frame_files(result, self._metric, self.export))

    def write_files(self, files: Mapping[str, bytes]) -> None:
        """Write a frame's files from `frame_files` in their order.

        Raises ExportError if one cannot be written, exists and must not be replaced, or is another frame's.
        """
        if self.export.names == "source":
            # The tree is the last of a frame's files.
            tree = list(files)[-1]
            if tree in self._trees:
                path = self.directory / tree
                raise ExportError(f"{path}: another frame has this file name; use --export-names number")
            self._trees.add(tree)
        for name, content in files.items():
            path = self.directory / name
            if not self.export.force and path.is_file():
                raise ExportError(
                    f"{path}: already exists; export to another folder, or overwrite results with --force"
                )
            try:
                write_atomically(path, content)
                if name.endswith(_OBJECTS_SUFFIX):
                    path = self.directory / OBJECTS_FILE
                    self._table.add(json.loads(content))
            except OSError as err:
                raise ExportError(
                    f"{path}: cannot be written: {err.strerror}; "
                    f"the {self.written} previous frames are kept in {self.directory}"
                ) from err
        self.written += 1


def refuse_other_results(directory: Path, settings: RunSettings) -> str | None:
    """Return the computer that made results in a folder, None without any.

    Raises ExportError if the folder contains results with other settings; unknown cameras are not others.
    """
    advice = "export to another folder, or delete this one"
    path = directory / SETTINGS_FILE
    try:
        before = read_json(path)
    except FileNotFoundError:
        if any(directory.glob("*_tree.json")):
            raise ExportError(f"{directory}: holds results without {SETTINGS_FILE}; {advice}") from None
        return None
    except ValueError as err:
        raise ExportError(f"{err}; {advice}") from err
    if settings.camera is None:
        before["camera"] = None
    made_by = before.pop("computer", "")
    now = json.loads(json.dumps(settings.document()))
    del now["computer"]
    if before != now:
        differing = ", ".join(differences(before, now))[:_DIFFERENCES_MOST]
        raise ExportError(f"{path}: belongs to another run: {differing}; {advice}")
    return str(made_by)


def differences(before: Any, now: Mapping[str, Any], section: str = "") -> list[str]:
    """Describe how the settings in a file differ from those of this run; `before` may be any JSON."""
    if not isinstance(before, Mapping):
        return [f"{section or 'the file'} has no settings there"]
    found = []
    for key in {**before, **now}:
        path = f"{section}.{key}".lstrip(".")
        was, own = before.get(key), now.get(key)
        if isinstance(own, Mapping):
            found += differences(was, own, path)
        elif was != own:
            found.append(f"{path} is {was} there and {own} now")
    return found
