"""Looks through the files of a recording for what its topics hold, and the transforms of its cameras."""

import logging
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, RecordingFormatError, named
from nurbseg.common.limits import SAMPLES_BYTES_MAX, TRANSFORMS_BYTES_MAX
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.cameras import chained
from nurbseg.drivers.mcap.container.messages import Messages
from nurbseg.drivers.mcap.container.parts import open_messages
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.topics import TopicSample, frame_of

_log = logging.getLogger(__name__)

#: Messages of a topic that are tried until one is whole.
_TRIES = 50
_STATIC = "tf_static"
#: RealSense's recordings state the meters of a depth unit by this topic: a number, or its text in a .db3.
_UNIT_TOPIC = "/option/Depth_Units/value"


class Scan:
    """The first message of each topic, and the transforms, of the messages of a recording.

    Raises RecordingFormatError if no message can be read.
    """

    def __init__(self, messages: Messages) -> None:
        self.samples: dict[str, TopicSample] = {}
        #: Why messages of a schema cannot be decoded, by its name; empty if they can.
        self.complaints: dict[str, str] = {}
        self._messages = messages
        self._static: list[ros.Transform] | None = None
        self._left = SAMPLES_BYTES_MAX
        self._damage = messages.damage
        for topic in messages.topics:
            self._take_sample(topic)
        if self._damage and all(sample.message is None for sample in self.samples.values()):
            raise RecordingFormatError(f"{self._damage}; no message can be read")

    def stated_unit(self) -> DepthUnit | None:
        """Return the unit of 16-bit depth that a RealSense's recording states; None if there is none."""
        for topic, (schema, _, _) in self._messages.topics.items():
            if topic.endswith(_UNIT_TOPIC):
                for content in islice(self._contents(topic), _TRIES):
                    meters = _number(content, schema.name)
                    if meters is not None and 1e-6 <= meters <= 1.0:
                        return DepthUnit(round(1 / meters, 3), f"{named(topic)}: {meters:g} m")
        return None

    def find_transform(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Return target_from_source, by transforms anywhere in the files; None if they do not say it.

        Static ones come first. A transform that changes counts as it was at first.
        """
        if self._static is None:
            self._static = self._transforms(static=True)
        found = chained(target, source, self._static)
        if found is None:
            found = chained(target, source, self._static + self._transforms(static=False))
        return found

    def _transforms(self, *, static: bool) -> list[ros.Transform]:
        found: dict[tuple[str, str], ros.Transform] = {}
        left = TRANSFORMS_BYTES_MAX
        for topic, (schema, _, _) in self._messages.topics.items():
            if (
                schema.name != ros.TRANSFORMS
                or topic.endswith(_STATIC) != static
                or not self._is_decodable(topic)
            ):
                continue
            for content in self._contents(topic):
                left -= len(content)
                if left < 0:
                    return list(found.values())
                with suppress(FrameFormatError):
                    message = ros.decode(content, ros.TRANSFORMS, str(self._messages.path))
                    for transform in ros.transforms_of(message):
                        found.setdefault(transform[:2], transform)
        return list(found.values())

    def _take_sample(self, topic: str) -> None:
        schema = self._messages.topics[topic].schema.name
        if not self._is_decodable(topic):
            return
        if schema == ros.TRANSFORMS:
            # They are read when they are asked for.
            self.samples[topic] = TopicSample(schema, None)
            return
        for content in islice(self._contents(topic), _TRIES):
            if len(content) > self._left:
                return
            with suppress(FrameFormatError):
                decoded = ros.decode(content, schema, f"{self._messages.path}: {named(topic)}")
                self._left -= len(content)
                self.samples[topic] = TopicSample(schema, decoded)
                return

    def _is_decodable(self, topic: str) -> bool:
        """Whether the messages of a topic can be decoded; logs once why not."""
        schema, encoding, _ = self._messages.topics[topic]
        if schema.name not in ros.DEFINITIONS or encoding != "cdr":
            return False
        if schema.name not in self.complaints:
            self.complaints[schema.name] = ""
            try:
                ros.check_schema(schema, str(self._messages.path))
            except RecordingFormatError as err:
                self.complaints[schema.name] = complaint = str(err)
                _log.warning("%s; its messages are skipped", complaint)
        return not self.complaints[schema.name]

    def _contents(self, topic: str) -> Iterator[bytes]:
        """Yield the messages of a topic."""
        for item in self._messages.messages([topic]):
            if isinstance(item, FrameFormatError):
                self._damage = self._damage or str(item)
            else:
                yield item.content


def _number(content: bytes, schema: str) -> float | None:
    """Return the number that a std_msgs/Float32 or String holds."""
    order = "<" if len(content) > 1 and content[1] & 1 else ">"
    with suppress(struct.error, ValueError):
        if schema == "std_msgs/msg/Float32":
            return float(struct.unpack_from(f"{order}f", content, 4)[0])
        if schema == "std_msgs/msg/String":
            return float(content[8:40].rstrip(b"\0"))
    return None


def other_messages(messages: Messages) -> str:
    """Say of which kind the messages of a recording are, if they are not those of ROS 2; else nothing."""
    encodings = {topic.encoding for topic in messages.topics.values()}
    schemas = {topic.schema.name for topic in messages.topics.values()}
    if messages.profile == "ros1" or "ros1" in encodings:
        return (
            "its messages are those of ROS 1 (ros1msg), which are not read; of the .bag that it was made of, "
            "rosbags-convert --src FILE.bag --dst FOLDER --dst-storage mcap makes one of ROS 2"
        )
    if foxglove := sorted(name for name in schemas if name.startswith(("foxglove.", "foxglove_msgs/"))):
        shown = ", ".join(foxglove[:3])
        return (
            f"its messages are Foxglove's ({shown}; {', '.join(sorted(encodings))}), which are not read yet; "
            "record sensor_msgs of ROS 2 instead"
        )
    if any(name.endswith("/PointCloud2") for name in schemas):
        return "point clouds are not read; record the depth images that they are made of"
    if encodings and "cdr" not in encodings:
        return f"its messages are encoded as {', '.join(sorted(encodings))}; only ROS 2's cdr is read"
    unread = sorted(schemas - ros.DEFINITIONS.keys())
    return f"not read: {', '.join(unread[:5])}" if unread else ""


@dataclass(frozen=True, slots=True)
class Stream:
    """A topic: its schema, and of images and cameras their encoding, frame and size (pixels).

    `rate_hz` is by the times of the log; 0 where it is not known.
    """

    topic: str
    schema: str
    encoding: str
    frame: str
    width: int
    height: int
    messages: int
    rate_hz: float


def list_streams(path: Path) -> list[Stream]:
    """Return the topics of a recording, or of the folder of a split bag, by name.

    Raises RecordingFormatError if it is not one, or no message can be read.
    """
    with open_messages(path) as messages:
        samples, span_s, topics = Scan(messages).samples, 1e-9 * messages.span_ns, messages.topics
    streams = []
    for topic, (schema, encoding, count) in sorted(topics.items()):
        sample = samples.get(topic)
        message = None if sample is None else sample.message
        form = str(getattr(message, "encoding", "") or getattr(message, "format", ""))
        rate_hz = round((count - 1) / span_s, 2) if span_s else 0.0
        frame = "" if sample is None else frame_of(sample)
        width, height = _size(topic, sample)
        streams.append(Stream(topic, schema.name or encoding, form, frame, width, height, count, rate_hz))
    return streams


def _size(topic: str, sample: TopicSample | None) -> tuple[int, int]:
    message = None if sample is None else sample.message
    if sample is None or message is None:
        return 0, 0
    if sample.schema != ros.COMPRESSED_IMAGE:
        return int(getattr(message, "width", 0)), int(getattr(message, "height", 0))
    is_depth = images.is_compressed_depth(message, topic)
    return images.size_of(message, sample.schema, topic, is_depth=is_depth) or (0, 0)
