"""Labels in ROS messages: whose they are, and those that cannot be used."""

from pathlib import Path

import numpy as np
import pytest
from recorded_scene import CAMERA, INTERVAL_NS, scene
from robot_bag import COLOR, DEPTH, INFO_TOPIC, Bag, bag_of, encoded, packed, raw

from nurbseg.drivers import SourceOptions, open_source

FRAME = scene(0)
STAMP, DEPTH_MM = FRAME.timestamp_ns, FRAME.depth_mm


@pytest.mark.parametrize("has_color", [True, False])
@pytest.mark.parametrize(("late", "found"), [(0, 3), (2, 3), (None, 0)])
def test_labels_that_a_program_made_of_the_images_are_theirs(tmp_path, has_color, late, found, caplog):
    bag = Bag(tmp_path / "a.mcap")
    for number in range(3 + (late or 0)):
        stamp = STAMP + number * INTERVAL_NS
        bag.info(INFO_TOPIC, stamp, "c", CAMERA)
        if number < 3:
            bag.image(DEPTH, stamp, "c", scene(number).depth_mm, "16UC1")
            if has_color:
                bag.image(COLOR, stamp, "c", scene(number).color, "rgb8")
        of = number - (late or 0)
        if of >= 0:
            own = STAMP + of * INTERVAL_NS + (late is None) * 1_000_000
            bag.image("/c/labels", own, "c", scene(of).labels, "16UC1", stamp + 20_000_000)
    with open_source(bag.close()) as source:
        frames = list(source)
    assert len(frames) == 3 and sum(frame.labels is not None for frame in frames) == found
    for number, frame in enumerate(frames[:found]):
        np.testing.assert_array_equal(frame.labels, scene(number).labels)
    assert ("3 label images have the time of no frame" in caplog.text) is (found == 0)


FEW = np.where(DEPTH_MM > 1500, 2, 1)
#: Label images, and what is said of those that cannot be used.
LABELS = [
    (raw("/c/instance_segmentation", FEW.astype(np.int32), "32SC1"), ""),
    (
        raw("/c/labels", np.where(FEW == 1, 65_536, 1).astype(np.int32), "32SC1"),
        "expected labels of 0 to 65535",
    ),
    (raw("/c/labels", np.where(FEW == 1, -1, 1).astype(np.int32), "32SC1"), "expected labels of 0 to 65535"),
    (packed("/c/labels", encoded(".png", FEW.astype(np.uint16)), "mono16; png compressed"), ""),
    (packed("/c/labels", encoded(".png", np.zeros((4, 4), np.uint16)), "mono16; png compressed"), "(48, 64)"),
    (
        packed("/c/labels", encoded(".png", FRAME.color), "mono16; png compressed"),
        "expected labels of 1 channel",
    ),
    (packed("/c/labels", b"\x89PNG\r\n\x1a\n and no more", "mono16; png compressed"), "cut off"),
]


@pytest.mark.parametrize("place", range(len(LABELS)))
def test_labels_that_cannot_be_used_cost_only_themselves(tmp_path: Path, place: int, caplog) -> None:
    write, said = LABELS[place]

    def color_and_labels(bag: Bag) -> None:
        raw(COLOR, FRAME.color, "rgb8")(bag)
        write(bag)

    with open_source(bag_of(tmp_path, None, color_and_labels)) as source:
        frame = source.read()
        assert said in source.labels_fault and bool(source.labels_fault) == bool(said)
        if said:
            assert frame.labels is None
            assert "frame 0: /c/labels: " in source.labels_fault
            assert source.metadata["labels_lost"] == "1"
            assert caplog.text.count("frames whose labels cannot be used are replayed without them") == 1
        else:
            np.testing.assert_array_equal(frame.labels, FEW)


@pytest.mark.parametrize("replayed", ["a", "b"])
@pytest.mark.parametrize("frame_ids", [("a", "b"), ("optical", "optical")], ids=["own", "same"])
@pytest.mark.parametrize(
    ("topics", "frame_id", "expected"),
    [
        (["/a/labels", "/b/labels"], "", {"a": 0, "b": 1}),
        (["/a/labels"], "", {"a": 0}),
        (["/b/labels"], "", {"b": 0}),
        # Of no camera by the name, and in nobody's frame or in that of the second.
        (["/net/labels"], "net", {"a": 0, "b": 0}),
        (["/net/labels"], "b", {"b": 0}),
    ],
)
def test_labels_are_those_of_the_camera_that_is_replayed(
    tmp_path, replayed: str, frame_ids, topics: list[str], frame_id: str, expected: dict[str, int]
) -> None:
    bag = Bag(tmp_path / "a.mcap")
    frames = dict(zip("ab", frame_ids, strict=True))
    for name, own in frames.items():
        bag.info(f"/{name}/camera_info", STAMP, own, CAMERA)
        bag.image(f"/{name}/depth/image", STAMP, own, DEPTH_MM, "16UC1")
    for number, topic in enumerate(topics):
        image = np.full((48, 64), number, np.uint8)
        bag.image(topic, STAMP, frame_id or frames[topic[1]], image, "8UC1")
    with open_source(bag.close(), SourceOptions(depth_topic=f"/{replayed}/depth/image")) as source:
        (frame,) = source
    if frame_id not in ("", *frame_ids):
        expected = {"a": 0, "b": 0}
    assert (None if frame.labels is None else int(frame.labels.max())) == expected.get(replayed)
