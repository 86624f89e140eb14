"""Writes the files of each frame's result, and of the settings."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.app.atomic_file import write_atomically, write_json
from nurbseg.app.export.cad import cad_file
from nurbseg.app.export.cloud import cloud_file
from nurbseg.app.export.config import ExportConfig
from nurbseg.app.export.mesh import mesh_file
from nurbseg.app.export.objects import ObjectTable, objects_document
from nurbseg.app.export.surfaces import surfaces_npz
from nurbseg.app.export.tree import tree_document, tree_graph
from nurbseg.app.result import FrameResult
from nurbseg.app.view.drawing.palette import LABEL_COLORS, label_colors
from nurbseg.drivers.calibration.cameras import calibration_table
from nurbseg.drivers.files import create_folder
from nurbseg.drivers.frame import Calibration
from nurbseg.segmentation.config import DepthConfig, Metric, SegmentationConfig

#: The file with the settings of all frames of an export.
SETTINGS_FILE = "settings.json"
#: The table of the objects of all frames.
OBJECTS_FILE = "objects.csv"
_OBJECTS_SUFFIX = "_objects.json"


class ExportError(Exception):
    """A result cannot be written; the message says where and why."""


def run_settings(
    config: SegmentationConfig,
    *,
    source: str = "",
    temporal: bool = False,
    target_fps: float = 0.0,
    surfaces: bool = False,
    depth: DepthConfig | None = None,
    calibration: Calibration | None = None,
) -> dict[str, Any]:
    """Return the content of ``settings.json``.

    `temporal` says whether a frame continues the previous one; `target_fps` is the rate that is maintained by
    a coarser grid, 1/s, or 0 if the grid is always that of `config`; `depth` is the preprocessing of depth;
    `calibration` holds the cameras, if known.
    """
    return {
        "source": source,
        "temporal": temporal,
        "target_fps": target_fps,
        "surfaces": surfaces,
        "depth": asdict(depth or DepthConfig()),
        "camera": None if calibration is None else calibration_table(calibration),
        "segmentation": asdict(config),
    }


def check_libraries(export: ExportConfig) -> None:
    """Raise ExportError if a format needs a missing library."""
    if export.cad is not None and find_spec("rhino3dm") is None:
        raise ExportError(
            f"--export-cad {export.cad}: needs rhino3dm, part of the extra 'cad': "
            "pip install 'nurbseg[cad]' (in the project's folder: pip install '.[cad]')"
        )


class Exporter:
    """Writes results to a folder, which is created if needed; see docs/files.md.

    A frame's tree is written last: if it exists, the frame's other files do. `settings` comes from
    `run_settings`; its `surfaces` overrides that of `export`. `written` counts frames.

    Raises ExportError if a format needs a missing library, or the folder cannot be created or contains
    results with other settings.
    """

    def __init__(
        self, directory: Path, settings: Mapping[str, Any], export: ExportConfig | None = None
    ) -> None:
        self.directory = directory
        self.written = 0
        self.export = replace(export or ExportConfig(), surfaces=settings["surfaces"])
        self._metric: Metric = settings["segmentation"]["metric"]
        self._table = ObjectTable(directory / OBJECTS_FILE)
        check_libraries(self.export)
        try:
            create_folder(directory)
        except ValueError as err:
            raise ExportError(str(err)) from err
        refuse_other_results(directory, settings)
        try:
            write_json(directory / SETTINGS_FILE, settings)
        except OSError as err:
            raise ExportError(f"{directory / SETTINGS_FILE}: cannot be written: {err.strerror}") from err

    def write(self, result: FrameResult) -> None:
        """Write the files of one frame; raises as `write_files` does."""
        self.write_files(frame_files(result, self._metric, self.export))

    def write_files(self, files: Mapping[str, bytes]) -> None:
        """Write a frame's files from `frame_files` in their order.

        Raises ExportError if one cannot be written, or exists and must not be replaced.
        """
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


def frame_files(result: FrameResult, metric: Metric, export: ExportConfig) -> dict[str, bytes]:
    """Return the files of a frame by name, the tree last; `metric` decided the splits."""
    tree = result.tree
    files = {"labels.png": png(result.labels())}
    if tree.objects:
        files["surfaces.png"] = png(result.labels("surfaces"))
        files["objects.png"] = png(result.labels("objects"))
    if export.preview:
        files["preview.png"] = _preview(result)
    if export.surfaces:
        files["surfaces.npz"] = surfaces_npz(tree)
    if export.cloud is not None:
        files[f"cloud.{export.cloud}"] = cloud_file(result, export.cloud)
    if export.mesh is not None:
        files[f"mesh.{export.mesh}"] = mesh_file(result, export.mesh)
    if export.cad is not None:
        files[f"surfaces.{export.cad}"] = cad_file(result)
    if export.graph:
        files["tree.dot"] = tree_graph(result, metric).encode()
    if export.objects:
        files["objects.json"] = _json(objects_document(result))
    files["tree.json"] = _json(tree_document(result, metric))
    stem = f"{result.frame.index:06d}"
    if export.names == "source" and result.frame.name:
        stem = re.sub(r"[^\w.-]", "_", result.frame.name)
    return {f"{stem}_{name}": content for name, content in files.items()}


def refuse_other_results(directory: Path, settings: Mapping[str, Any]) -> None:
    """Raise ExportError if a folder contains results with other settings; unknown cameras are not others."""
    advice = "export to another folder, or delete this one"
    path = directory / SETTINGS_FILE
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if any(directory.glob("*_tree.json")):
            raise ExportError(f"{directory}: holds results without {SETTINGS_FILE}; {advice}") from None
        return
    except (OSError, ValueError) as err:
        raise ExportError(f"{path}: cannot be read: {err}; {advice}") from err
    if settings["camera"] is None and isinstance(before, dict):
        before["camera"] = None
    now = json.loads(json.dumps(settings))
    if before != now:
        differing = ", ".join(differences(before, now))
        raise ExportError(f"{path}: belongs to another run: {differing}; {advice}")


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


def _json(document: Mapping[str, Any]) -> bytes:
    return (json.dumps(document, indent=1) + "\n").encode()


def _preview(result: FrameResult) -> bytes:
    """Return the colored labels over the gray frame."""
    labels = result.labels()
    colors = np.vstack([np.zeros((1, 3), dtype=np.uint8), label_colors()])
    painted = colors[np.where(labels > 0, (labels - 1) % LABEL_COLORS + 1, 0)]
    gray = cv2.cvtColor(cv2.cvtColor(result.cloud.color, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    return png(cv2.cvtColor(cv2.addWeighted(painted, 0.65, gray, 0.35, 0.0), cv2.COLOR_RGB2BGR))


def png(image: NDArray[Any]) -> bytes:
    """Encode an image, BGR if it is in color."""
    return cv2.imencode(".png", image)[1].tobytes()
