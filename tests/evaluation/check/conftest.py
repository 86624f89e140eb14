"""Exports of two frames by settings that give every reason to stop, and copies of them to damage."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from rendered import rendered

from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.common.settings import setting_named
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.check.check import FolderCheck
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig, Stag15Config
from nurbseg.segmentation.methods import segment

RECORDING = rendered("width=160&height=120&frames=2")
CONFIGS = {
    "stag15": SegmentationConfig(
        method="stag15",
        decimation=2,
        depth_max=3,
        splits_max=5,
        stag15=Stag15Config(segment_pixels_min=600),
    ),
    "curvature": SegmentationConfig(
        method="stag15",
        splits_max=4,
        metric="vmxc",
        ratio_max=3.0,
        stag15=Stag15Config(segment_pixels_min=600),
    ),
    "counts": SegmentationConfig(
        method="stag15",
        metric="nle",
        large_error_m=0.02,
        decimation=1,
        stag15=Stag15Config(segment_pixels_min=600),
    ),
    "nurbseg": SegmentationConfig(splits_max=8, depth_max=4),
    "strict": SegmentationConfig(
        ratio_max=0.3, depth_max=3, extended=ExtendedConfig(inverse_depth_noise=1e-3, piece_pixels_min=240)
    ),
    "floored": SegmentationConfig(metric="nle", large_error_m=0.02, splits_max=4),
    "no floor": SegmentationConfig(metric="nlc", large_curvature_per_m=1e3, splits_max=4),
    "hurried": SegmentationConfig(budget_ms=3500.0, decimation=2),
    "surfaces": SegmentationConfig(splits_max=4, decimation=3, extended=ExtendedConfig(level="surfaces")),
}


class Export:
    """A folder of exports that can be changed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def tree(self, change: Callable[[dict[str, dict[str, Any]]], object], *, frame: int = 0) -> None:
        """Change the segments of a frame by their names."""
        self.document(lambda tree: change({each["name"]: each for each in tree["segments"]}), frame=frame)

    def document(self, change: Callable[[dict[str, Any]], object], *, frame: int = 0) -> None:
        """Change what a tree's file holds."""
        path = self.folder / f"{frame:06d}_tree.json"
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))

    def segments(self, *, frame: int = 0) -> dict[str, dict[str, Any]]:
        """Return the segments of a frame by name."""
        document = json.loads((self.folder / f"{frame:06d}_tree.json").read_text())
        return {each["name"]: each for each in document["segments"]}

    def first(self, is_one: Callable[[dict[str, Any]], object]) -> str:
        """Return the name of the first frame's first segment for which `is_one` holds."""
        return next(name for name, segment in self.segments().items() if is_one(segment))

    def arrays(self, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the arrays of the first frame's surfaces."""
        path = self.folder / "000000_surfaces.npz"
        with np.load(path) as file:
            arrays = dict(file)
        change(arrays)
        np.savez_compressed(path, **arrays)

    def settings(self, **changes: object) -> Path:
        """Change settings of the export, and return their file."""
        path = self.folder / "settings.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))
        return path

    def setting(self, name: str, value: object) -> None:
        """Change a setting of the segmentation."""
        segmentation = json.loads((self.folder / "settings.json").read_text())["segmentation"]
        *section, last = setting_named(SegmentationConfig, name)[0].split(".")
        target = segmentation[section[0]] if section else segmentation
        target[last] = value
        self.settings(segmentation=segmentation)

    def keep_first_tree_alone(self) -> None:
        """Remove the second frame, and the surfaces."""
        for path in (*self.folder.glob("000001_*"), self.folder / "000000_surfaces.npz"):
            path.unlink()
        self.settings(surfaces=False)

    def findings(self, recording: str | None = None) -> list[str]:
        """Return what the check finds."""
        return [str(finding) for finding in FolderCheck(self.folder, recording).findings()]

    def finds(self, *patterns: str, recording: str | None = None) -> bool:
        """Whether the check has a finding for each of these regular expressions."""
        found = "\n".join(self.findings(recording))
        return all(re.search(pattern, found) for pattern in patterns)


@pytest.fixture(scope="session")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder of each configuration."""
    folder = tmp_path_factory.mktemp("exports")
    with open_source(RECORDING) as source:
        frames = list(source)
    for name, config in CONFIGS.items():
        exporter = Exporter(folder / name, RunSettings(config, source=RECORDING, surfaces=True))
        for frame in frames:
            result = process_frame(frame, config)
            # A second goes by before each cut.
            tree = segment(result.cloud, config, clock=count().__next__)
            exporter.write(replace(result, tree=tree))
    return {name: folder / name for name in CONFIGS}


@pytest.fixture
def export_in() -> Callable[[Path], Export]:
    """What makes an export of the folder that it is in."""
    return Export


@pytest.fixture
def export(exports: dict[str, Path], tmp_path: Path) -> Callable[[str], Export]:
    """A function that returns a copy of an export."""

    def copy(name: str) -> Export:
        return Export(Path(shutil.copytree(exports[name], Path(mkdtemp(dir=tmp_path)) / name)))

    return copy
