"""What a run gives to other programs, as independent clients receive it."""

from __future__ import annotations

import json
import logging
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import cast
from urllib.parse import urlsplit

import pytest
from standing import BOXES, looking, seen
from waiting import wait_until
from websocket_client import FoxgloveClient
from websockets.exceptions import InvalidStatus

from nurbseg.app.errors import PublishError
from nurbseg.app.export.objects import objects_document
from nurbseg.app.publish.lines import SocketLines
from nurbseg.app.publish.opening import open_publisher
from nurbseg.app.publish.publisher import Publisher, Sink
from nurbseg.app.settings.output_config import PublishConfig
from nurbseg.app.view.viewer import free_port
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import SegmentationConfig

CAMERA = looking((0.0, -0.9, 0.7), (0.0, 0.1, 0.0))


@pytest.fixture(scope="module")
def results() -> list[FrameResult]:
    segmenter = Segmenter()
    found = []
    for index in range(3):
        boxes = BOXES if index < 2 else BOXES[:2]
        found.append(segmenter.process(seen(CAMERA, boxes, index=index)))
        assert found[-1].objects
    return found


def test_lines_on_standard_output_hold_every_frame_of_a_replay_as_fast_as_possible() -> None:
    command = [Path(sys.executable).with_name("nurbseg-live"), "--replay", "recordings/demo.mcap"]
    options = ["--speed", "0", "--frames", "3", "--view", "none", "--temporal", "on", "--publish", "jsonl"]
    done = subprocess.run([*command, *options], capture_output=True, timeout=120, check=True)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["frame"] for line in lines] == [0, 1, 2]
    for line in lines:
        assert len(line["objects"]) == 12 and line["age_s"] is None
        assert line["latency_ms"]["capture_to_labels"] > line["latency_ms"]["segment"] > 0
        assert line["support"]["found_by"] == "largest"


def test_a_reader_that_leaves_ends_the_lines_but_not_the_run() -> None:
    command = f"{Path(sys.executable).with_name('nurbseg-live')} --replay recordings/demo.mcap --speed 0 "
    command += "--frames 6 --view none --publish jsonl 2>&1 >&3 | cat >&2"
    shell = f"exec 3> >(head -c 10 > /dev/null); {command}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "nobody reads the lines any more" in done.stderr and "6 frames segmented" in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_standard_output_is_one_sentence() -> None:
    command = f"{Path(sys.executable).with_name('nurbseg-live')} --replay recordings/demo.mcap --speed 0 "
    shell = f"{command} --frames 3 --view none --publish jsonl > /dev/full"
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "standard output: No space left on device; it is not published to any more" in done.stderr
    assert "Traceback" not in done.stderr and "3 frames segmented" in done.stderr


def listener(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(10)
    connection.connect(str(path))
    return connection


def received(connection: socket.socket) -> bytes:
    with connection.makefile("rb") as file:
        return file.read()


def test_everyone_who_connects_to_the_socket_gets_whole_lines(
    results: list[FrameResult], tmp_path: Path
) -> None:
    path = tmp_path / "results"
    sink = SocketLines(path)
    assert path.stat().st_mode & 0o777 == 0o600
    one, other = listener(path), listener(path)
    for result in results:
        sink.publish(result)
    sink.close()
    for connection in (one, other):
        with connection:
            lines = [json.loads(line) for line in received(connection).splitlines()]
        assert [line["frame"] for line in lines] == [0, 1, 2]
        seen_s = 1e-9 * (lines[1]["timestamp_ns"] - lines[0]["timestamp_ns"])
        assert all(each["seen_s"] == pytest.approx(seen_s, abs=1e-6) for each in lines[1]["objects"])
        for line, result in zip(lines, results, strict=True):
            document = json.loads(json.dumps(objects_document(result)))
            assert {name: line[name] for name in document} == document
        # What was taken away is lost, not gone without a word.
        assert len(lines[2]["lost"]) == 1 and 0 < lines[2]["lost"][0]["lost_s"] < 0.1
    assert not path.exists()


def test_a_listener_that_takes_nothing_slows_nobody(results: list[FrameResult], tmp_path: Path) -> None:
    sink = SocketLines(tmp_path / "results")
    slow, fast = listener(tmp_path / "results"), listener(tmp_path / "results")
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    got: list[bytes] = []
    reading = threading.Thread(target=lambda: got.extend(received(fast).splitlines()))
    reading.start()
    begun = b""
    for n in range(200):
        sink.publish(results[0])
        if n > 100:
            # What it takes now and then ends within a line.
            begun += slow.recv(3000)
    sink.close()
    reading.join(10)
    assert len(got) > 100 and all(json.loads(line)["frame"] == 0 for line in got)
    rest = (begun + received(slow)).split(b"\n")
    fast.close()
    slow.close()
    assert 0 < len(rest) < 200 and all(json.loads(line)["frame"] == 0 for line in rest[:-1])


def test_the_socket_of_a_killed_run_is_replaced_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "results"
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(path))
    left.close()
    running = SocketLines(path)
    with pytest.raises(PublishError, match="another run publishes there"):
        SocketLines(path)
    running.close()
    path.write_text("a letter")
    with pytest.raises(PublishError, match="something else has this name"):
        SocketLines(path)
    assert path.read_text() == "a letter"


class Stuck(Sink):
    def __init__(self) -> None:
        super().__init__()
        self.go, self.frames = threading.Event(), list[int]()

    def publish(self, result: FrameResult) -> None:
        self.frames.append(result.frame.index)
        self.go.wait(10)

    def close(self) -> None:
        self.frames.append(-1)


def test_a_run_never_waits_for_what_is_published_and_the_newest_counts(results: list[FrameResult]) -> None:
    sink = Stuck()
    publisher = Publisher([sink])
    started_s = time.monotonic()
    publisher.publish(results[0])
    while not sink.frames:
        time.sleep(0.001)
    for result in results[1:]:
        publisher.publish(result)
    assert time.monotonic() - started_s < 5
    sink.go.set()
    publisher.close()
    assert sink.frames == [0, 2, -1] and publisher.figures[0]["dropped"] == 1


@pytest.fixture
def told() -> list[str]:
    """What listeners asked of the run."""
    return []


@pytest.fixture
def foxglove(told: list[str], caplog: pytest.LogCaptureFixture) -> Iterator[tuple[Publisher, str]]:
    """A publisher, and the address that it logs."""
    pytest.importorskip("foxglove")
    caplog.set_level(logging.INFO, logger="nurbseg")
    publisher = open_publisher(
        PublishConfig(how=f"foxglove:{free_port('127.0.0.1')}"),
        SegmentationConfig(),
        every=True,
        ask=told.append,
    )
    assert publisher is not None
    yield publisher, caplog.messages[-1].rpartition(" ")[2]
    publisher.close()


def test_foxglove_gets_results_images_points_and_boxes(
    results: list[FrameResult], foxglove: tuple[Publisher, str]
) -> None:
    publisher, address = foxglove
    client = FoxgloveClient(address)
    messages = client.messages()
    topics = {
        "/color": "foxglove.CompressedImage",
        "/depth": "foxglove.RawImage",
        "/labels": "foxglove.RawImage",
        "/calibration": "foxglove.CameraCalibration",
        "/points": "foxglove.PointCloud",
        "/objects": "foxglove.SceneUpdate",
        "/tf": "foxglove.FrameTransforms",
        "/results": "",
    }
    publishing = threading.Event()

    def publish() -> None:
        while not publishing.is_set():
            publisher.publish(results[1])
            time.sleep(0.05)

    thread = threading.Thread(target=publish)
    thread.start()
    found: dict[str, bytes] = {}
    try:
        while len(client.channels) < len(topics):
            next(messages)
        names = {topic: channel["schemaName"] for topic, channel in client.channels.items()}
        assert names | {"/results": ""} == topics
        client.subscribe(*topics)
        for message in messages:
            if isinstance(message, tuple):
                found[message[0]] = message[2]
                assert message[1] == results[1].frame.timestamp_ns
            if len(found) == len(topics):
                break
    finally:
        publishing.set()
        thread.join()
        client.close()
    document = json.loads(found["/results"])
    assert [each["object"] for each in document["objects"]] == [each.label for each in results[1].objects]
    # Strings and images of protobuf are in it as they are.
    assert results[1].frame.depth_mm.tobytes() in found["/depth"]
    assert results[1].labels("objects").tobytes() in found["/labels"]
    assert b"\xff\xd8\xff" in found["/color"] and b"support" in found["/tf"]
    assert all(str(each.label).encode() in found["/objects"] for each in results[1].objects)


def test_foxglove_changes_settings(foxglove: tuple[Publisher, str], told: list[str]) -> None:
    publisher, address = foxglove
    client = FoxgloveClient(address)
    messages = client.messages()
    client.send({"op": "getParameters", "parameterNames": [], "id": "a"})
    values = next(
        message for message in messages if isinstance(message, dict) and message["op"] == "parameterValues"
    )
    assert {parameter["name"]: parameter["value"] for parameter in values["parameters"]} == {
        "T": 1.0,
        "lambda": SegmentationConfig().geometry_weight,
        "metric": "mse",
        "level": "objects",
        "method": "nurbseg",
    }
    changes = [{"name": "T", "value": 0.9}, {"name": "metric", "value": "mae"}, {"name": "x", "value": 1}]
    client.send({"op": "setParameters", "parameters": changes, "id": "b"})
    wait_until(lambda: len(told) == 2, "the commands arrive")
    assert told == ["ratio 0.9", "metric mae"]
    publisher.configured(SegmentationConfig(ratio_max=0.9, metric="vgc"))
    client.send({"op": "getParameters", "parameterNames": ["T", "metric"], "id": "c"})
    values = next(message for message in messages if isinstance(message, dict) and message.get("id") == "c")
    assert [parameter["value"] for parameter in values["parameters"]] == [0.9, "vgc"]
    client.close()


def test_foxglove_is_open_to_those_who_know_its_address(
    foxglove: tuple[Publisher, str], told: list[str], results: list[FrameResult]
) -> None:
    publisher, address = foxglove
    parts = urlsplit(address)
    assert len(parts.path) > 20
    for path in ("/", "", "/guess", f"/?{parts.path[1:]}", parts.path[:-1]):
        with pytest.raises(InvalidStatus, match="403"):
            FoxgloveClient(f"ws://{parts.netloc}{path}")
    publisher.publish(results[0])
    assert told == []
    # Foxglove's own application is a page of another host.
    FoxgloveClient(address, Origin="https://app.foxglove.dev").close()


NEGATIVE = '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 0}]}'


@pytest.mark.parametrize(
    "message",
    [
        *("", "{", "[]", "1", '{"op": 1}', '{"op": "subscribe"}', NEGATIVE, NEGATIVE.replace("-1", '"x"')),
        *('{"op": "setParameters", "parameters": 1}', "[" * 60_000, b"\x01", f"[{'1' * 5000}]"),
    ],
)
def test_a_listener_that_sends_something_else_is_no_trouble(
    foxglove: tuple[Publisher, str], results: list[FrameResult], message: str | bytes
) -> None:
    publisher, address = foxglove
    other, client = FoxgloveClient(address), FoxgloveClient(address)
    other._connection.send(message)
    messages = client.messages()
    while not client.channels:
        next(messages)
    client.subscribe("/results")
    client.send({"op": "getParameters", "parameterNames": ["T"], "id": "a"})
    assert next(messages) == {"op": "parameterValues", "parameters": [{"name": "T", "value": 1.0}], "id": "a"}
    publisher.publish(results[0])
    topic, _, content = cast("tuple[str, int, bytes]", next(messages))
    assert (topic, json.loads(content)["frame"]) == ("/results", 0)
    client.close()
    other.close()


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ("ros", "expected jsonl or foxglove, got 'ros'"),
        ("foxglove:0", "expected a port from 1 to 65535, got '0'"),
    ],
)
def test_an_unknown_way_of_publishing_is_named(how: str, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        PublishConfig(how=how)
    with pytest.raises(ValueError, match="expected an IP address"):
        PublishConfig(bind="everywhere")


def test_a_port_that_is_taken_is_an_error_before_the_run() -> None:
    pytest.importorskip("foxglove")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(PublishError, match=rf"127.0.0.1:{port}: Foxglove's server cannot listen"):
            open_publisher(PublishConfig(how=f"foxglove:{port}"), SegmentationConfig(), every=False)
