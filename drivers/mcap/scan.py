"""Looks through the files of a recording for what its topics hold, and the transforms of its cameras."""

import logging
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, RecordingFormatError, listed, named
from nurbseg.common.files import ROSBAG_MAGIC, SQLITE_MAGIC, open_regular
from nurbseg.common.limits import SAMPLES_BYTES_MAX, TRANSFORMS_BYTES_MAX
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.cameras import chained
from nurbseg.drivers.mcap.container.bag import MessageFile, bag_files, parts_in
from nurbseg.drivers.mcap.container.file import McapFile
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.topics import TopicSample, frame_of

_log = logging.getLogger(__name__)

#: Messages of a topic that are tried until one is whole.
_TRIES = 50
_STATIC = "tf_static"
#: Schemas of compressed video.
_VIDEO = re.compile(r"CompressedVideo$|FFMPEGPacket$|theora_image_transport.*Packet$")
#: RealSense's recordings state the meters of a depth unit by this topic: a number, or its text in a .db3.
_UNIT_TOPIC = "/option/Depth_Units/value"


class Scan:
    """The first message of each topic, and its transforms.

    Raises RecordingFormatError if no message can be read.
    """

    def __init__(self, files: Sequence[MessageFile]) -> None:
        self.samples: dict[str, TopicSample] = {}
        #: Why messages of a schema cannot be decoded.
        self.complaints: dict[tuple[Path, int], str] = {}
        self._files = files
        self._static: list[ros.Transform] | None = None
        self._left = SAMPLES_BYTES_MAX
        for file in files:
            file.find_messages()
            for channel in list(file.channels.values()):
                if channel.topic not in self.samples:
                    self._take_sample(file, channel)
        damage = next((text for file in files for text in file.damaged.values()), None)
        if damage is not None and all(sample.message is None for sample in self.samples.values()):
            raise RecordingFormatError(f"{damage}; no message can be read")

    def stated_unit(self) -> DepthUnit | None:
        """Return the unit of 16-bit depth that a RealSense's recording states; None if there is none."""
        for file in self._files:
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                if not channel.topic.endswith(_UNIT_TOPIC) or schema is None:
                    continue
                for content in islice(_contents(file, channel), _TRIES):
                    meters = _number(content, schema.name)
                    if meters is not None and 1e-6 <= meters <= 1.0:
                        return DepthUnit(round(1 / meters, 3), f"{named(channel.topic)}: {meters:g} m")
        return None

    def videos(self) -> str:
        """Say which topics are compressed video, and what decodes it; else nothing."""
        found = {
            channel.topic: schema.name.rpartition("/")[2]
            for file in self._files
            for channel in file.channels.values()
            if (schema := file.schemas.get(channel.schema_id)) is not None and _VIDEO.search(schema.name)
        }
        listing = listed(f"{named(topic)} ({named(name)})" for topic, name in found.items())
        how = "video is not decoded: record what image_transport's republish makes of it"
        return f"; {listing}: {how}" if found else ""

    def learn_from(self, path: Path) -> None:
        """Add the static transforms, and the cameras of topics without one, that another file has."""
        with open_bag_file(path) as file:
            other = Scan([file])
            self._static = self._transforms(static=True) + other._transforms(static=True)
        for topic, sample in other.samples.items():
            if sample.schema == ros.CAMERA_INFO:
                self.samples.setdefault(topic, sample)

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
        for file in self._files:
            for channel in self._channels(file, ros.TRANSFORMS):
                if channel.topic.endswith(_STATIC) != static:
                    continue
                for content in _contents(file, channel):
                    left -= len(content)
                    if left < 0:
                        return list(found.values())
                    with suppress(FrameFormatError):
                        message = ros.decode(content, ros.TRANSFORMS, str(file.path))
                        for transform in ros.transforms_of(message):
                            found.setdefault(transform[:2], transform)
        return list(found.values())

    def _channels(self, file: MessageFile, schema: str) -> list[Channel]:
        return [
            channel
            for channel in file.channels.values()
            if (own := file.schemas.get(channel.schema_id)) is not None
            and own.name == schema
            and self._is_decodable(file, own, channel)
        ]

    def _take_sample(self, file: MessageFile, channel: Channel) -> None:
        schema = file.schemas.get(channel.schema_id)
        if schema is None or not self._is_decodable(file, schema, channel):
            return
        if schema.name == ros.TRANSFORMS:
            # They are read when they are asked for.
            self.samples[channel.topic] = TopicSample(schema.name, None)
            return
        for content in islice(_contents(file, channel), _TRIES):
            if len(content) > self._left:
                return
            try:
                decoded = ros.decode(content, schema.name, f"{file.path}: {named(channel.topic)}")
            except FrameFormatError:
                continue
            self._left -= len(content)
            self.samples[channel.topic] = TopicSample(schema.name, decoded)
            return

    def _is_decodable(self, file: MessageFile, schema: Schema, channel: Channel) -> bool:
        """Whether messages of a schema can be decoded; logs once why not."""
        if schema.name not in ros.DEFINITIONS or channel.message_encoding != "cdr":
            return False
        key = (file.path, schema.id)
        if key not in self.complaints:
            self.complaints[key] = ""
            try:
                ros.check_schema(schema, str(file.path))
            except RecordingFormatError as err:
                self.complaints[key] = complaint = str(err)
                _log.warning("%s; its messages are skipped", complaint)
        return not self.complaints[key]


def _contents(file: MessageFile, channel: Channel) -> Iterator[bytes]:
    """Yield the messages of a channel; a damaged one is empty."""
    for run in file.runs(channel.id):
        for offset in run.offsets.tolist():
            try:
                yield file.message(run.entry, offset).data
            except FrameFormatError:
                yield b""


def _number(content: bytes, schema: str) -> float | None:
    """Return the number that a std_msgs/Float32 or String holds."""
    order = "<" if len(content) > 1 and content[1] & 1 else ">"
    with suppress(struct.error, ValueError):
        if schema == "std_msgs/msg/Float32":
            return float(struct.unpack_from(f"{order}f", content, 4)[0])
        if schema == "std_msgs/msg/String":
            return float(content[8:40].rstrip(b"\0"))
    return None


def other_messages(files: Sequence[MessageFile]) -> str:
    """Say of which kind the messages of a recording are, if they are not those of ROS 2; else nothing."""
    file = files[0]
    encodings = {channel.message_encoding for channel in file.channels.values()}
    # A file may state schemas that none of its messages has.
    used = {channel.schema_id for channel in file.channels.values()}
    schemas = {schema.name for number, schema in file.schemas.items() if number in used}
    if file.profile == "ros1" or "ros1" in encodings:
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


def open_bag_file(path: Path) -> MessageFile:
    """Open one file of a recording; raises RecordingFormatError as those of its kind do."""
    with open_regular(path) as stream:
        head = stream.read(len(SQLITE_MAGIC))
    if head == SQLITE_MAGIC:
        from nurbseg.drivers.mcap.bags.database import DatabaseFile

        return DatabaseFile(path)
    if head.startswith(ROSBAG_MAGIC):
        from nurbseg.drivers.mcap.bags.ros1 import Ros1File

        return Ros1File(path)
    return McapFile(path)


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
    """Return the topics of an MCAP file, or of the folder of a split bag, by name.

    Raises RecordingFormatError if it is not one, or no message can be read.
    """
    found: dict[str, tuple[str, list[np.ndarray[tuple[int], np.dtype[np.int64]]]]] = {}
    samples: dict[str, TopicSample] = {}
    for part in (parts_in(path) or bag_files(path)) if path.is_dir() else [path]:
        with open_bag_file(part) as file:
            samples |= {k: v for k, v in Scan([file]).samples.items() if k not in samples}
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                name = schema.name if schema is not None else channel.message_encoding
                times = found.setdefault(channel.topic, (name, []))[1]
                times += [run.times_ns for run in file.runs(channel.id)]
    streams = []
    for topic, (schema_name, runs) in sorted(found.items()):
        times_ns = np.concatenate(runs) if runs else np.zeros(0, np.int64)
        span_s = float(np.ptp(times_ns)) * 1e-9 if times_ns.size else 0.0
        sample = samples.get(topic)
        message = None if sample is None else sample.message
        encoding = str(getattr(message, "encoding", "") or getattr(message, "format", ""))
        width, height = _size(topic, sample)
        rate_hz = round((times_ns.size - 1) / span_s, 2) if span_s else 0.0
        frame = "" if sample is None else frame_of(sample)
        count = int(times_ns.size)
        streams.append(Stream(topic, schema_name, encoding, frame, width, height, count, rate_hz))
    return streams


def _size(topic: str, sample: TopicSample | None) -> tuple[int, int]:
    message = None if sample is None else sample.message
    if sample is None or message is None:
        return 0, 0
    if sample.schema != ros.COMPRESSED_IMAGE:
        return int(getattr(message, "width", 0)), int(getattr(message, "height", 0))
    is_depth = images.is_compressed_depth(message, topic)
    return images.size_of(message, sample.schema, topic, is_depth=is_depth) or (0, 0)
