"""Looks through the files of a recording for what its topics hold."""

import logging
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from nurbseg.common.errors import FrameFormatError, RecordingFormatError, named
from nurbseg.common.limits import SAMPLES_BYTES_MAX
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.messages import Messages
from nurbseg.drivers.mcap.container.parts import open_messages
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.motion import Transforms
from nurbseg.drivers.mcap.topics import TopicSample

_log = logging.getLogger(__name__)

#: Messages of a topic that are tried until one is whole.
_TRIES = 50
#: RealSense's recordings state the meters of a depth unit by this topic: a number, or its text in a .db3.
_UNIT_TOPIC = "/option/Depth_Units/value"


class Scan:
    """The first message of each topic of a recording; `find_transform` finds transforms between frames.

    Raises RecordingFormatError if no message can be read.
    """

    def __init__(self, messages: Messages) -> None:
        self.samples: dict[str, TopicSample] = {}
        self._messages, self._damage, self._left = messages, messages.damage, SAMPLES_BYTES_MAX
        for topic, (schema, encoding, _) in messages.topics.items():
            if schema in ros.DEFINITIONS and encoding == "cdr":
                self._take_sample(topic, schema)
        of_transforms = [topic for topic, sample in self.samples.items() if sample.schema == ros.TRANSFORMS]
        self.find_transform = Transforms(messages, of_transforms).find
        if self._damage and all(sample.message is None for sample in self.samples.values()):
            raise RecordingFormatError(f"{self._damage}; no message can be read")

    def stated_unit(self) -> DepthUnit | None:
        """Return the unit of 16-bit depth that a RealSense's recording states; None if there is none."""
        for topic, (schema, _, _) in self._messages.topics.items():
            for content in islice(self._contents(topic), _TRIES) if topic.endswith(_UNIT_TOPIC) else ():
                meters = _number(content, schema)
                if meters is not None and 1e-6 <= meters <= 1.0:
                    return DepthUnit(round(1 / meters, 3), f"{named(topic)}: {meters:g} m")
        return None

    def unread(self) -> str:
        """Return which messages are not read, and what to do; "" if all are."""
        kinds = {(schema, encoding) for schema, encoding, _ in self._messages.topics.values()}
        others = sorted(kinds - {(name, "cdr") for name in ros.DEFINITIONS})
        how = "record sensor_msgs of ROS 2, in cdr"
        if any(encoding == "ros1" for _, encoding in others):
            how = "of the .bag of ROS 1, rosbags-convert --src FILE --dst FOLDER --dst-storage mcap makes one"
        elif any(name.endswith("/PointCloud2") for name, _ in others):
            how = "record the depth images that the clouds are made of"
        shown = ", ".join(f"{name} ({encoding})" for name, encoding in others[:5])
        return f"not read: {shown}; {how}" if others else ""

    def _take_sample(self, topic: str, schema: str) -> None:
        if schema == ros.TRANSFORMS:  # read when they are needed
            self.samples[topic] = TopicSample(topic, schema, None)
            return
        for content in islice(self._contents(topic), _TRIES):
            if len(content) > self._left:
                return
            with suppress(FrameFormatError):
                decoded = ros.decode(content, schema, f"{self._messages.path}: {named(topic)}")
                self._left -= len(content)
                self.samples[topic] = TopicSample(topic, schema, decoded)
                return

    def _contents(self, topic: str) -> Iterator[bytes]:
        """Yield the messages of a topic that are whole."""
        for item in self._messages.messages([topic]):
            if isinstance(item, FrameFormatError):
                self._damage = self._damage or str(item)
            else:
                yield item.content


def _number(content: bytes, schema: str) -> float | None:
    """Return the number that a std_msgs/Float32 or String holds."""
    order = "<" if len(content) > 1 and content[1] & 1 else ">"
    with suppress(struct.error, ValueError):
        is_text = schema.endswith("String")
        return float(
            content[8:40].rstrip(b"\0") if is_text else struct.unpack_from(f"{order}f", content, 4)[0]
        )
    return None


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
        sample = samples.get(topic) or TopicSample(topic, "", None)
        size = getattr(sample.message, "width", 0), getattr(sample.message, "height", 0)
        if sample.schema == ros.COMPRESSED_IMAGE:
            is_depth = images.is_compressed_depth(sample.message, topic)
            size = images.size_of(sample.message, sample.schema, topic, is_depth=is_depth) or (0, 0)
        rate_hz = round((count - 1) / span_s, 2) if span_s else 0.0
        streams.append(
            Stream(topic, schema or encoding, sample.encoding, sample.frame, *size, count, rate_hz)
        )
    return streams
