"""The settings of an export, and whether a folder has results with others."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from nurbseg.app.errors import ExportError
from nurbseg.common.files import read_json
from nurbseg.common.frame import Calibration
from nurbseg.drivers.calibration.cameras import calibration_table
from nurbseg.segmentation.config import TRIALS_MAX, DepthConfig, SegmentationConfig

#: The file with the settings of all frames of an export.
SETTINGS_FILE = "settings.json"
#: Characters of the differences from other settings: the file may hold anything.
_DIFFERENCES_MOST = 2000


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
