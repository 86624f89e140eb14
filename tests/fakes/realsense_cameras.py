"""RealSense cameras that tests plug in: the real SDK in the programs that are started lists them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

SDK = Path(__file__).parent / "realsense_sdk"


class Cameras:
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def plug(self, serial: str = "935322001", **settings: Any) -> None:
        path = self.folder / f"{serial}.json"
        path.with_suffix(".part").write_text(json.dumps(settings))
        path.with_suffix(".part").rename(path)

    def unplug(self, serial: str = "935322001") -> None:
        (self.folder / f"{serial}.json").unlink()


@pytest.fixture
def cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cameras:
    pytest.importorskip(
        "pyrealsense2",
        reason="RealSense's SDK is missing: pip install 'nurbseg[realsense]', apt install libusb-1.0-0",
        exc_type=ImportError,
    )
    folder = tmp_path / "cameras"
    folder.mkdir()
    monkeypatch.setenv("REALSENSE_FOLDER", str(folder))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SDK), os.environ.get("PYTHONPATH", "")]))
    return Cameras(folder)
