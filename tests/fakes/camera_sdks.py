"""What the SDKs of cameras answer when one is connected, as their documentation and their modules say."""

from __future__ import annotations

import os
import tempfile
import time
from datetime import timedelta
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

DEPTH = (1000 + np.arange(48 * 64).reshape(48, 64)).astype(np.uint16)


class Anything:
    """Any attribute, any call, any item: what a pipeline is built of."""

    def __init__(self, **known: Any) -> None:
        self.__dict__.update(known)

    def __getattr__(self, name: str) -> Any:
        return Anything()

    def __call__(self, *args: Any, **options: Any) -> Any:
        return Anything()

    def __getitem__(self, key: Any) -> Any:
        return Anything()


def depthai(frames: int) -> ModuleType:
    """An OAK that is unplugged after some frames."""
    number = iter(range(frames))

    def get(timeout: timedelta) -> Any:
        time.sleep(0.005)
        count = next(number, None)
        if count is None:
            raise RuntimeError("Communication exception - possible device error/misconfiguration")
        stamp = timedelta(seconds=count / 30)
        depth = SimpleNamespace(
            getTimestampDevice=lambda: stamp, getFrame=lambda: np.resize(DEPTH, (400, 640))
        )
        return {
            "depth": depth,
            "color": SimpleNamespace(getFrame=lambda: np.full((400, 640, 3), 90, np.uint8)),
        }

    class Pipeline(Anything):
        def __init__(self, device: Any) -> None:
            super().__init__()

        def create(self, kind: Any) -> Any:
            return Anything(out=SimpleNamespace(createOutputQueue=lambda **_: SimpleNamespace(get=get)))

    matrix = [[500.0, 0, 320.0], [0, 500.0, 200.0], [0, 0, 1]]
    calibration = SimpleNamespace(getCameraIntrinsics=lambda socket, width, height: matrix)
    device = SimpleNamespace(
        readCalibration=lambda: calibration, getDeviceName=lambda: "OAK-D", getDeviceId=lambda: "14442C"
    )
    module: Any = ModuleType("depthai")
    module.__dict__.update(Device=lambda *info: device, DeviceInfo=str, Pipeline=Pipeline)
    module.node = module.ImgFrame = module.CameraBoardSocket = Anything()
    return module


def pyorbbecsdk(frames: int) -> ModuleType:
    """A Gemini of a depth unit of .5 mm, whose color camera is 25 mm to the left."""
    number = iter(range(frames))

    def image(pixels: np.ndarray, count: int) -> Any:
        return SimpleNamespace(
            get_data=lambda: pixels.reshape(-1).view(np.uint8),
            get_height=lambda: pixels.shape[0],
            get_width=lambda: pixels.shape[1],
            get_depth_scale=lambda: 0.5,
            get_timestamp_us=lambda: 33_333 * count + 5,
        )

    def wait_for_frames(timeout_ms: int) -> Any:
        time.sleep(0.005)
        count = next(number, None)
        if count is None:
            return None
        depth, color = image(DEPTH, count), image(np.full((60, 80, 3), 70, np.uint8), count)
        return SimpleNamespace(get_depth_frame=lambda: depth, get_color_frame=lambda: color)

    def camera(width: int, height: int) -> Any:
        return SimpleNamespace(width=width, height=height, fx=60.0, fy=60.0, cx=width / 2, cy=height / 2)

    lens = SimpleNamespace(k1=0.1, k2=-0.05, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)
    found = SimpleNamespace(
        depth_intrinsic=camera(64, 48),
        depth_distortion=lens,
        rgb_intrinsic=camera(80, 60),
        rgb_distortion=lens,
        transform=SimpleNamespace(rot=np.eye(3), transform=[-25.0, 0.0, 0.0]),
    )
    info = SimpleNamespace(get_name=lambda: "Gemini 2", get_serial_number=lambda: "AY1")
    devices = SimpleNamespace(
        get_count=lambda: 1,
        get_device_serial_number_by_index=lambda index: "AY1",
        get_device_by_serial_number=lambda serial: SimpleNamespace(get_device_info=lambda: info),
    )
    pipeline = Anything(wait_for_frames=wait_for_frames, get_camera_param=lambda: found)
    module: Any = ModuleType("pyorbbecsdk")
    module.Context = lambda: SimpleNamespace(query_devices=lambda: devices)
    module.Pipeline, module.Config = lambda device: pipeline, Anything
    module.OBStreamType = module.OBFormat = module.OBFrameAggregateOutputMode = Anything()
    return module


def connect(monkeypatch: pytest.MonkeyPatch, name: str, frames: int = 400) -> None:
    """Let programs that are started from now on find a simulated SDK."""
    folder = Path(tempfile.mkdtemp())
    code = f"import sys, camera_sdks\nsys.modules[{name!r}] = camera_sdks.{name}({frames})\n"
    (folder / f"{name}.py").write_text(code)
    others = (str(folder), str(Path(__file__).parent), os.environ.get("PYTHONPATH", ""))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(others))
