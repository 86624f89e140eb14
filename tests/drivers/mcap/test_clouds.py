"""Organized point clouds in place of depth images: depth, color and camera, and what is refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from logged_messages import COLOR, DEPTH, FRAME, IMAGE, TYPES, bag, header, image, plain_color, plain_depth
from mcap_ros2.writer import Writer as Ros2Writer
from numpy.typing import NDArray
from recorded_scene import CAMERA, RGBDFrame, scenes

from nurbseg.common.errors import CalibrationError, FrameFormatError
from nurbseg.drivers import RecordingFormatError, SourceOptions, open_source
from nurbseg.drivers.mcap.ros_messages import DEFINITIONS, IMU, POINT_CLOUD
from nurbseg.drivers.mcap.topics import TopicSample, choose_topics


def cloud(
    frame: RGBDFrame, kind: str = "<f4", rows: slice | None = None, *, of_body: bool = False
) -> tuple[str, Any]:
    """The points of a frame as a driver logs them, with color, padding and NaN where there is no depth.

    `of_body`: x is forward, y left and z up.
    """
    v, u = np.indices(frame.depth_mm.shape)
    z = np.where(frame.depth_mm > 0, frame.depth_mm / 1000.0, np.nan)
    red, green, blue = np.moveaxis(frame.color.astype(np.uint32), -1, 0)
    order = kind[0]
    layout = np.dtype(
        {
            "names": ["x", "y", "z", "rgb"],
            "formats": [kind, kind, kind, f"{order}u4"],
            "offsets": [0, 8, 16, 24],
            "itemsize": 32,
        }
    )
    points = np.zeros(z.shape, layout)
    points["x"], points["y"], points["z"] = (
        (u - CAMERA.cx) / CAMERA.fx * z,
        (v - CAMERA.cy) / CAMERA.fy * z,
        z,
    )
    points["rgb"] = red << 16 | green << 8 | blue
    if of_body:
        points["x"], points["y"], points["z"] = z, -points["x"], -points["y"]
    points = points[rows or slice(None)]
    padded = np.pad(points.view(np.uint8).reshape(len(points), -1), ((0, 0), (0, 64)))
    field = TYPES.types["sensor_msgs/msg/PointField"]
    number = {"f4": 7, "f8": 8}[kind[1:]]
    message = TYPES.types["sensor_msgs/msg/PointCloud2"](
        header=header(frame.timestamp_ns),
        height=len(points),
        width=64,
        fields=[
            *(field(name=name, offset=8 * n, datatype=number, count=1) for n, name in enumerate("xyz")),
            # Said to be a float, as PCL does.
            field(name="rgb", offset=24, datatype=7, count=1),
        ],
        is_bigendian=order == ">",
        point_step=32,
        row_step=32 * 64 + 64,
        data=padded.ravel(),
        is_dense=False,
    )
    return "sensor_msgs/msg/PointCloud2", message


@pytest.mark.parametrize("of_body", [False, True])
@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8"])
def test_organized_clouds_are_depth_with_the_camera_and_color_of_their_points(
    tmp_path: Path, kind: str, of_body: bool
) -> None:
    def of_kind(frame: RGBDFrame) -> tuple[str, Any]:
        return cloud(frame, kind, of_body=of_body)

    # Nothing says in which frame the camera beside them is.
    with open_source(bag(tmp_path, of_kind, plain_color)) as source:
        assert source.metadata["depth_unit"] == "1 per meter (ROS REP 103: clouds are in meters)"
        frames = list(source)
    for frame, expected in zip(frames, scenes(3), strict=True):
        assert np.array_equal(frame.depth_mm, expected.depth_mm)
        assert np.array_equal(frame.color, expected.color)
        assert frame.timestamp_ns == expected.timestamp_ns
        assert frame.calibration.is_registered
        assert np.allclose(frame.calibration.depth.matrix, CAMERA.matrix, atol=1e-2)


def some_of(message: Any, points: int) -> None:
    """Leave so many points in the middle, in rows of 15."""
    content = message.data.copy().reshape(48, -1)
    kept = np.zeros((48, 64), bool)
    kept[20 : 20 + points // 15, 20:35] = True
    content[:, :2048].reshape(48, 64, 32)[~kept, :24] = np.frombuffer(
        np.full(6, np.nan, "<f4").tobytes(), np.uint8
    )
    message.data = content.ravel()


@pytest.mark.parametrize(("points", "are_read"), [(0, False), (90, False), (150, True)])
def test_of_a_later_cloud_of_few_points_none_is_misread(tmp_path: Path, points: int, are_read: bool) -> None:
    def fewer(frame: RGBDFrame) -> tuple[str, Any]:
        kind, message = cloud(frame, of_body=True)
        if frame.index == 1:
            some_of(message, points)
        return kind, message

    with open_source(bag(tmp_path, fewer, plain_color)) as source:
        first, second, _ = list(source)
    assert np.count_nonzero(first.depth_mm) > 1000
    expected = np.zeros_like(first.depth_mm)
    # Too few do not tell in which axes they are.
    if are_read:
        expected[20 : 20 + points // 15, 20:35] = scenes(3)[1].depth_mm[20 : 20 + points // 15, 20:35]
    assert np.array_equal(second.depth_mm, expected)


def test_a_first_cloud_without_points_keeps_nobody_from_finding_the_camera(tmp_path: Path) -> None:
    def late(frame: RGBDFrame) -> tuple[str, Any]:
        kind, message = cloud(frame)
        if frame.index == 0:
            some_of(message, 0)
        return kind, message

    with open_source(bag(tmp_path, late, plain_color)) as source:
        frames = list(source)
    assert not frames[0].depth_mm.any()
    assert np.array_equal(frames[1].depth_mm, scenes(3)[1].depth_mm)
    assert np.allclose(frames[0].calibration.depth.matrix, CAMERA.matrix, atol=1e-2)


def test_depth_images_go_before_clouds_whatever_their_names(tmp_path: Path) -> None:
    path = bag(tmp_path, cloud, plain_depth)
    with open_source(path) as source:
        assert (source.metadata["depth_topic"], source.metadata["color_topic"]) == (COLOR, "none")
    with open_source(path, SourceOptions(depth_topic=DEPTH)) as source:
        assert np.array_equal(source.read().color, FRAME.color)


def test_labels_beside_clouds_are_theirs() -> None:
    samples = {
        "/points": TopicSample(POINT_CLOUD, cloud(FRAME)[1]),
        "/labels": TopicSample(IMAGE, image(FRAME, FRAME.depth_mm, "mono16")[1]),
    }
    (topics,) = choose_topics(Path("a.mcap"), samples)
    assert (topics.depth, topics.color, topics.labels) == ("/points", None, "/labels")


def tampered(change: Callable[[Any], None]) -> Callable[[RGBDFrame], tuple[str, Any]]:
    def make(frame: RGBDFrame) -> tuple[str, Any]:
        kind, message = cloud(frame)
        change(message)
        return kind, message

    return make


def mirrored(message: Any) -> None:
    """X is forward, y right and z down, as nobody has it."""
    x, y, z, *_ = message.fields
    x.name, y.name, z.name = "y", "z", "x"


def points_of(message: Any) -> NDArray[np.float32]:
    """The (48, 64, 8) numbers of a cloud's points in 4 bytes each, x, y and z in every second."""
    return message.data.reshape(48, -1)[:, :2048].reshape(48, 64, 32).view("<f4")


def of_robot(message: Any) -> None:
    """In the frame of a robot that stands below the camera, which looks down by 30 degrees."""
    message.data = message.data.copy()
    points = points_of(message)
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    y, z = points[..., 2].copy(), points[..., 4].copy()
    points[..., 2], points[..., 4] = cosine * y + sine * z - 1.0, cosine * z - sine * y


def of_lidar(message: Any) -> None:
    """Rings of 360 degrees at heights of -20 to 20 degrees, in a lidar's own axes."""
    message.data = message.data.copy()
    points = points_of(message)
    up, around = np.meshgrid(np.linspace(0.35, -0.35, 48), np.linspace(-np.pi, np.pi, 64), indexing="ij")
    points[..., 0] = 3 * np.cos(up) * np.cos(around)
    points[..., 2] = 3 * np.cos(up) * np.sin(around)
    points[..., 4] = 3 * np.sin(up)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (of_robot, "do not lie on a pinhole camera's rays"),
        (of_lidar, "do not lie on a pinhole camera's rays"),
        (mirrored, "do not lie on a pinhole camera's rays"),
        (
            lambda message: setattr(message, "row_step", 2040),
            "point_step, row_step: x at byte 0 does not fit",
        ),
        (lambda message: setattr(message, "point_step", 18), "z at byte 16 does not fit"),
        (
            lambda message: setattr(message, "data", message.data[:5000]),
            "data: the cloud is cut off: 5000 bytes",
        ),
        (
            lambda message: setattr(message.fields[2], "datatype", 9),
            "expected numbers called z, got x of type 7",
        ),
        (
            lambda message: setattr(message.fields[1], "name", "why"),
            "expected numbers called y, got x of type 7",
        ),
    ],
)
def test_a_cloud_that_is_no_depth_cameras_is_refused(
    tmp_path: Path, change: Callable[[Any], None], said: str
) -> None:
    with pytest.raises(CalibrationError, match=f"{DEPTH}: .*{said}"):
        open_source(bag(tmp_path, tampered(change), plain_color))


def test_a_cloud_that_is_cut_off_costs_its_frame(tmp_path: Path) -> None:
    def later(frame: RGBDFrame) -> tuple[str, Any]:
        kind, message = cloud(frame)
        if frame.index == 1:
            message.data = message.data[:5000]
        return kind, message

    with open_source(bag(tmp_path, later, plain_color)) as source:
        source.read()
        with pytest.raises(FrameFormatError, match=f"frame 1: {DEPTH}: data: the cloud is cut off"):
            source.read()
        assert source.read().index == 2


def test_what_is_wrong_with_clouds_without_rows_is_said(tmp_path: Path) -> None:
    def row(frame: RGBDFrame) -> tuple[str, Any]:
        return cloud(frame, rows=slice(1))

    with pytest.raises(RecordingFormatError, match=r"its point clouds do not have the rows and columns of"):
        open_source(bag(tmp_path, row, plain_color))


def test_schemas_without_messages_are_not_told_of(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Ros2Writer(file)
        writer.register_msgdef(POINT_CLOUD, DEFINITIONS[POINT_CLOUD])
        imu = writer.register_msgdef(IMU, DEFINITIONS[IMU])
        message = {"header": {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "imu"}}
        writer.write_message("/imu", imu, message)
        writer.finish()
    with pytest.raises(RecordingFormatError, match="no topic of depth images") as error:
        open_source(tmp_path / "a.mcap")
    assert "its point clouds" not in str(error.value)
