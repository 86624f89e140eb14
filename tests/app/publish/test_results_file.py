"""The file of results, as ROS 2's messages, read by programs that share nothing with what wrote it."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from standing import BOXES, looking, seen
from waiting import wait_until

from nurbseg.app.errors import PublishError
from nurbseg.app.publish import results_file
from nurbseg.app.publish.opening import open_publisher
from nurbseg.app.publish.publisher import Publisher
from nurbseg.app.publish.results_file import ResultsFile
from nurbseg.app.settings.output_config import PublishConfig
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import SegmentationConfig

CAMERA = looking((0.0, -0.9, 0.7), (0.0, 0.1, 0.0))
WORLD = np.eye(4)
WORLD[:3, 3] = 1.0, 2.0, 3.0

#: The messages of the package vision_msgs 4, as its documentation lists them.
VISION_MSGS = {
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
}


@pytest.fixture(scope="module")
def results() -> list[FrameResult]:
    segmenter = Segmenter()
    frames = [seen(CAMERA, BOXES, index=n) for n in range(3)]
    return [segmenter.process(replace(frame, world_from_camera=WORLD)) for frame in frames]


@pytest.fixture(scope="module")
def written(results: list[FrameResult], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "a.mcap"
    publisher = open_publisher(PublishConfig(file=str(path)), SegmentationConfig(), every=True)
    assert publisher is not None
    for result in results:
        publisher.publish(result)
    publisher.close()
    return path


@pytest.mark.parametrize("stamp_ns", [-5, 1 << 63])
def test_a_time_that_cannot_be_written_is_said(
    results: list[FrameResult], stamp_ns: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    publisher = open_publisher(PublishConfig(file=str(tmp_path / "a.mcap")), SegmentationConfig(), every=True)
    assert publisher is not None
    publisher.publish(results[0])
    frame = replace(results[1].frame, timestamp_ns=stamp_ns)
    publisher.publish(replace(results[1], frame=frame))
    publisher.close()
    assert (
        f"timestamp_ns: expected a time from 1970 to 2038, got {stamp_ns}; it is not published" in caplog.text
    )
    assert len(list(decoded(tmp_path / "a.mcap", "/tf"))) > 0


def decoded(path: Path, *topics: str) -> Iterator[tuple[str, Any]]:
    """Yield the topic and content of each message, by the definitions in the file."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=topics or None):
            yield channel.topic, message


def xyz(message: Any) -> list[float]:
    return [message.x, message.y, message.z]


def turn(message: Any) -> np.ndarray:
    return Rotation.from_quat([*xyz(message), message.w]).as_matrix()


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec * 10**9 + header.stamp.nanosec)


def check_messages(messages: dict[str, list[Any]], results: list[FrameResult]) -> None:
    """Compare the decoded messages of each topic with the results."""
    assert sorted(messages) == [
        *("/nurbseg/camera_info", "/nurbseg/labels", "/nurbseg/objects", "/nurbseg/points", "/tf")
    ]
    assert len(messages["/tf"]) == 6
    for n, result in enumerate(results):
        stamp = result.frame.timestamp_ns
        labels = messages["/nurbseg/labels"][n]
        assert (labels.encoding, labels.is_bigendian, stamp_ns(labels.header)) == ("mono16", 0, stamp)
        image = np.frombuffer(bytes(labels.data), "<u2").reshape(labels.height, labels.step // 2)
        np.testing.assert_array_equal(image, result.labels("objects"))
        info, camera = messages["/nurbseg/camera_info"][n], result.frame.calibration.depth
        assert (info.width, info.height, stamp_ns(info.header)) == (camera.width, camera.height, stamp)
        assert [info.k[m] for m in (0, 4, 2, 5)] == [camera.fx, camera.fy, camera.cx, camera.cy]
        check_detections(messages["/nurbseg/objects"][n], result)
        check_points(messages["/nurbseg/points"][n], result)
        world, support = (each.transforms[0] for each in messages["/tf"][2 * n : 2 * n + 2])
        assert (world.header.frame_id, world.child_frame_id) == ("world", labels.header.frame_id)
        assert xyz(world.transform.translation) == [1.0, 2.0, 3.0] and world.transform.rotation.w == 1.0
        assert (support.header.frame_id, support.child_frame_id) == (labels.header.frame_id, "support")
        # A point of the support's plane below the camera, and up, in the camera's frame.
        found = result.objects[0].support
        assert found is not None
        np.testing.assert_allclose(turn(support.transform.rotation)[:, 2], found.normal, atol=1e-9)
        below = -found.camera_height_m * found.normal
        np.testing.assert_allclose(xyz(support.transform.translation), below, atol=1e-9)


def check_detections(message: Any, result: FrameResult) -> None:
    assert len(message.detections) == len(result.objects) == 4
    for detection, each in zip(message.detections, result.objects, strict=True):
        assert detection.id == str(each.label)
        (found,) = detection.results
        assert (found.hypothesis.class_id, found.hypothesis.score) == ("object", float(each.is_sure))
        for pose in (detection.bbox.center, found.pose.pose):
            np.testing.assert_allclose(xyz(pose.position), each.box.center_m)
            np.testing.assert_allclose(turn(pose.orientation), each.box.axes.T, atol=1e-6)
        np.testing.assert_allclose(xyz(detection.bbox.size), each.box.size_m)
        covariance = np.reshape(found.pose.covariance, (6, 6))
        np.testing.assert_allclose(np.sqrt(np.diag(covariance)[:3]), each.sigma.center_m)
        # About the height it is the yaw's; about the others nothing is said.
        turns = each.box.axes @ covariance[3:, 3:] @ each.box.axes.T
        np.testing.assert_allclose(turns, np.diag([0.0, 0.0, each.sigma.yaw_rad**2]), atol=1e-12)


def check_points(message: Any, result: FrameResult) -> None:
    fields = {field.name: (field.offset, field.datatype, field.count) for field in message.fields}
    assert fields == {"x": (0, 7, 1), "y": (4, 7, 1), "z": (8, 7, 1), "rgb": (12, 7, 1), "label": (16, 4, 1)}
    content = bytes(message.data)
    assert len(content) == message.row_step == message.point_step * message.width > 1000
    rows = np.frombuffer(content, np.uint8).reshape(message.width, message.point_step)
    points = np.ascontiguousarray(rows[:, :12]).view("<f4")
    labels = np.ascontiguousarray(rows[:, 16:18]).view("<u2")[:, 0]
    packed = np.ascontiguousarray(rows[:, 12:16]).view("<u4")[:, 0]
    camera = result.frame.calibration.depth
    u, v = (
        np.rint(points[:, n] / points[:, 2] * f + c).astype(int)
        for n, f, c in ((0, camera.fx, camera.cx), (1, camera.fy, camera.cy))
    )
    np.testing.assert_array_equal(labels, result.labels("objects")[v, u])
    np.testing.assert_allclose(points[:, 2] * 1000, result.frame.depth_mm[v, u], atol=0.01)
    red, green, blue = result.cloud.color[v, u].astype(np.uint32).T
    np.testing.assert_array_equal(packed & 0xFFFFFF, red << 16 | green << 8 | blue)


def test_rosbags_with_its_own_definitions_decodes_every_message(
    written: Path, results: list[FrameResult]
) -> None:
    rosbags = pytest.importorskip("rosbags.typesys", reason="rosbags is missing: pip install 'nurbseg[bags]'")
    types = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    for name, text in VISION_MSGS.items():
        types.register(rosbags.get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    messages: dict[str, list[Any]] = {}
    with written.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and message.log_time == message.publish_time
            content = types.deserialize_cdr(message.data, schema.name)
            messages.setdefault(channel.topic, []).append(content)
    check_messages(messages, results)


def test_mcap_ros2_support_decodes_every_message_by_the_definitions_in_the_file(
    written: Path, results: list[FrameResult]
) -> None:
    messages: dict[str, list[Any]] = {}
    for topic, message in decoded(written):
        messages.setdefault(topic, []).append(message)
    check_messages(messages, results)


def test_rerun_reads_labels_points_and_transforms(
    written: Path, results: list[FrameResult], tmp_path: Path
) -> None:
    from rerun.chunk import RrdReader

    rrd = tmp_path / "a.rrd"
    rerun = str(Path(sys.executable).with_name("rerun"))
    command = [rerun, "mcap", "convert", str(written), "-o", str(rrd)]
    subprocess.run(command, timeout=120, capture_output=True, check=True)
    found: dict[tuple[str, str], list[Any]] = {}
    for chunk in RrdReader(str(rrd)).stream():
        batch = chunk.to_record_batch()
        for name in set(batch.schema.names) - {"message_log_time", "message_publish_time", "ros2_timestamp"}:
            column = batch.column(name)
            found.setdefault((str(chunk.entity_path), name), []).extend(column.to_pylist())
    labels = [np.array(row[0], dtype=np.uint8) for row in found["/nurbseg/labels", "DepthImage:buffer"]]
    points = found["/nurbseg/points", "Points3D:positions"]
    for n, result in enumerate(results):
        expected = result.labels("objects")
        np.testing.assert_array_equal(labels[n].view("<u2").reshape(expected.shape), expected)
        # Of every other row and column, since there are more than 40,000.
        coarse = expected[::2, ::2] > 0
        np.testing.assert_array_equal(points[n], result.cloud.points_m[::2, ::2][coarse])
    assert found["/tf", "Transform3D:child_frame"][1::2] == [["support"]] * 3
    assert len(found["/nurbseg/objects", "vision_msgs.msg.Detection3DArray:message"]) == 3


def test_a_slow_disk_never_slows_a_run_and_what_is_missing_is_said(
    results: list[FrameResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / "a.mcap"
    sink, go = ResultsFile(path), threading.Event()
    write = ResultsFile.publish

    def slowly(self: ResultsFile, result: FrameResult) -> None:
        go.wait(30)
        write(self, result)

    monkeypatch.setattr(ResultsFile, "publish", slowly)
    publisher = Publisher([sink])
    publisher.publish(results[0])
    wait_until(lambda: not publisher._outlets[0]._queue.filled, "the sink has the first result")
    for _ in range(2):
        for _ in range(results_file._WAITING_MAX):
            publisher.publish(results[1])
    go.set()
    publisher.close()
    kept = 1 + results_file._WAITING_MAX
    assert publisher.figures == [{"to": str(path), "published": kept, "dropped": kept - 1}]
    assert f"{path}: {kept - 1} of {2 * kept - 1} results are not in it" in caplog.text
    assert len(list(decoded(path, "/nurbseg/objects"))) == kept


def test_a_full_disk_ends_the_file_and_not_the_run(
    results: list[FrameResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / "a.mcap"
    publisher = Publisher([ResultsFile(path)], every=True)
    publisher.publish(results[0])
    wait_until(lambda: publisher.figures[0]["published"] == 1, "a result is written")
    monkeypatch.setattr(results_file, "free_space", lambda path: 1000)
    given = 2
    publisher.publish(results[2])
    while not publisher._outlets[0].ended:
        publisher.publish(results[1])
        given += 1
    publisher.close()
    assert "less than 200 MB of disk space are left; it is not published to any more" in caplog.text
    assert len(list(decoded(path, "/nurbseg/objects"))) == publisher.figures[0]["published"] == 1
    assert publisher.figures[0]["dropped"] == given - 1
    assert f"{given - 1} of {given} results are not in it" in caplog.text


def test_a_file_that_is_there_is_kept_and_one_without_frames_goes(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("a letter")
    with pytest.raises(PublishError, match=r"a\.mcap: .*exists"):
        open_publisher(PublishConfig(file=str(path)), SegmentationConfig(), every=False)
    assert path.read_text() == "a letter"
    with pytest.raises(PublishError, match=r"a\.mcap/b\.mcap: .*(directory|exists)"):
        ResultsFile(path / "b.mcap")
    with pytest.raises(ValueError, match=r"file: expected a name that ends in \.mcap"):
        PublishConfig(file="a.db3")
    # Its folder is made, as for other files of a run.
    path = tmp_path / "new" / "b.mcap"
    Publisher([ResultsFile(path)]).close()
    assert path.parent.is_dir() and not path.exists()


def test_a_run_writes_its_results_and_reports_it(tmp_path: Path) -> None:
    command = [str(Path(sys.executable).with_name("nurbseg-live")), "recordings/demo.mcap", "--speed", "0"]
    options = ["--frames", "3", "--view", "none", "--temporal", "on"]
    files = ["--save-objects", str(tmp_path / "a.mcap"), "--report", str(tmp_path / "a.json")]
    subprocess.run([*command, *options, *files], capture_output=True, timeout=120, check=True)
    found = [message for _, message in decoded(tmp_path / "a.mcap", "/nurbseg/objects")]
    assert [len(each.detections) for each in found] == [12, 12, 12]
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["publications"] == [{"to": str(tmp_path / "a.mcap"), "published": 3, "dropped": 0}]
