"""Lists what the topics of a recording hold, whether it can be replayed or not."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.bag import bag_files, parts_in
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.scan import Scan, open_bag_file
from nurbseg.drivers.mcap.topics import TopicSample, frame_of


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
