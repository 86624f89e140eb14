"""The examples: those of files are run as they are, those of cameras with something in the camera's place."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from realsense_cameras import Cameras, cameras

__all__ = ["cameras"]

EXAMPLES = Path(__file__).parent.parent / "examples"
DEMO = EXAMPLES.parent / "recordings" / "demo.mcap"


def ran(name: str, *words: str | Path) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def plate_before_a_wall() -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """An RGB image and a depth image, mm, of 160 x 120 pixels: a plate at 1 m before a wall at 2 m."""
    color = np.full((120, 160, 3), (200, 40, 40), dtype=np.uint8)
    depth = np.full((120, 160), 2000, dtype=np.uint16)
    color[40:80, 50:100], depth[40:80, 50:100] = (20, 40, 220), 1000
    return color, depth


def test_own_arrays(tmp_path: Path) -> None:
    color, depth = plate_before_a_wall()
    cv2.imwrite(str(tmp_path / "c.png"), color[..., ::-1])
    cv2.imwrite(str(tmp_path / "d.png"), depth)
    camera = ("130", "130", "79.5", "59.5")
    told = ran("own_arrays.py", tmp_path / "c.png", tmp_path / "d.png", *camera, tmp_path / "l.png")
    # 49 and 39 pixels between the outermost, at 1 m.
    assert re.search(r"object 2: 2000 px at \(-0\.04, 0\.00, 1\.00\) m, 38 x 30 x 0 cm", told)
    labels = cv2.imread(str(tmp_path / "l.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(labels, np.where(depth == 1000, 2, 1))


def test_a_ros2_bag(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "bag_0.mcap").symlink_to(DEMO)
    lines = ran("ros2_bag.py", bag, tmp_path / "labels").splitlines()
    written = sorted((tmp_path / "labels").iterdir(), key=lambda path: int(path.stem))
    assert [path.stem for path in written] == [line.split()[0] for line in lines]
    assert len(written) == 48
    assert lines[0].count("new") > 5
    for path in written:
        labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert labels.dtype == np.uint16
        assert np.unique(labels).size > 5


def test_a_realsense_camera(cameras: Cameras, capsys: pytest.CaptureFixture[str]) -> None:
    cameras.plug()
    loaded("realsense").main(2, spawn=False)
    printed = capsys.readouterr().out
    assert printed.count("frames skipped so far") == 2
    assert ": object 1 at (" in printed


def test_the_notebook(tmp_path: Path) -> None:
    cells = json.loads((EXAMPLES / "frame.ipynb").read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    program = "\n".join(
        [
            "import matplotlib as mpl",
            "mpl.use('Agg')",
            *code,
            f"figure.savefig({str(tmp_path / 'above.png')!r})",
        ]
    )
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, cwd=EXAMPLES, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    first, *lines = done.stdout.splitlines()
    found = re.fullmatch(r"(\d+) objects, (\d+) surfaces", first)
    assert found is not None
    # The wall, the table and at least most of the twelve things on it; a line for each, then eight leaves.
    assert int(found[1]) > 10
    assert len(lines) == int(found[1]) + 8
    above = cv2.imread(str(tmp_path / "above.png"))
    assert above is not None and above.std() > 10


def test_every_example_is_documented_and_tested() -> None:
    names = {path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb")}
    page = (EXAMPLES.parent / "docs" / "library.md").read_text()
    assert names == {
        "frame.ipynb",
        "own_arrays.py",
        "realsense.py",
        "ros2_bag.py",
        "ros2_node.py",
    }
    assert names == set(re.findall(r"examples/(\w+\.(?:py|ipynb))\)", page))


class Record:
    """A stand-in for a ROS message: every field is there, and is a record itself until it is set."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value: Any = [] if name == "results" else Record()
        setattr(self, name, value)
        return value


def test_ros2_node(monkeypatch: pytest.MonkeyPatch) -> None:
    published: list[Any] = []

    class Node:
        def __init__(self, name: str) -> None:
            self.name = name

        def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
            return Record(publish=published.append)

    def module(name: str, **names: Any) -> None:
        made = ModuleType(name)
        made.__dict__.update(names)
        monkeypatch.setitem(sys.modules, name, made)

    bridge = Record(imgmsg_to_cv2=lambda message, encoding="": message.image)
    module("rclpy")
    module("rclpy.node", Node=Node)
    module("cv_bridge", CvBridge=lambda: bridge)
    module(
        "message_filters",
        Subscriber=lambda *_: None,
        ApproximateTimeSynchronizer=lambda *_, **__: Record(registerCallback=lambda _: None),
    )
    module("sensor_msgs")
    module("sensor_msgs.msg", CameraInfo=Record, Image=Record)
    names = ("Detection3D", "Detection3DArray", "ObjectHypothesisWithPose")
    module("vision_msgs")
    module("vision_msgs.msg", **dict.fromkeys(names, Record))
    node = loaded("ros2_node").ObjectsNode()
    color, depth = plate_before_a_wall()
    header = Record(stamp=Record(sec=7, nanosec=5), frame_id="camera")
    for image in (depth, (depth / 1000).astype(np.float32)):
        info = Record(k=[130.0, 0, 79.5, 0, 130.0, 59.5, 0, 0, 1])
        node.segment(Record(header=header, image=image), Record(header=header, image=color), info)
    assert len(published) == 2
    for message in published:
        assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == (
            "camera",
            7,
            5,
        )
        plate = max(message.detections, key=lambda detection: detection.id)
        box = plate.bbox
        assert (box.size.x, box.size.y, box.size.z) == pytest.approx((0.38, 0.3, 0.0), abs=0.02)
        place = box.center.position
        assert (place.x, place.y, place.z) == pytest.approx((-0.04, 0.0, 1.0), abs=0.02)
        turn = box.center.orientation
        assert turn.x**2 + turn.y**2 + turn.z**2 + turn.w**2 == pytest.approx(1.0)
        (result,) = plate.results
        assert len(result.pose.covariance) == 36 and 0 < result.pose.covariance[0] < 1e-3
