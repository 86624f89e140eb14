"""Writes the files of each frame's result."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.app.errors import ExportError
from nurbseg.app.export.objects import ObjectTable
from nurbseg.app.export.run_settings import SETTINGS_FILE, RunSettings, refuse_other_results
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.common.files import create_folder, write_atomically, write_json
from nurbseg.library.models.forms import missing_library

if TYPE_CHECKING:
    from nurbseg.library.result import FrameResult

#: The table of the objects of all frames.
OBJECTS_FILE = "objects.csv"
_OBJECTS_SUFFIX = "_objects.json"


def check_libraries(export: ExportConfig) -> None:
    """Raise ExportError if a format needs a missing library."""
    if export.cad is not None and (missing := missing_library()):
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
