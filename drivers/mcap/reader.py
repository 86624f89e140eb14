"""Replays recordings: MCAP files of ROS 2 messages, our own and others'."""

import logging
from bisect import bisect_right
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, get_args

from mcap.records import Channel, Message, Schema

from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.closing import closed_on_error
from nurbseg.drivers.errors import EndOfRecordingError, FrameFormatError, RecordingFormatError
from nurbseg.drivers.frame import Calibration, RGBDFrame
from nurbseg.drivers.limits import SAMPLES_BYTES_MAX, SCAN_BYTES_MAX, STAMP_END_NS, TRANSFORMS_BYTES_MAX
from nurbseg.drivers.mcap import messages as ros
from nurbseg.drivers.mcap.file import McapFile
from nurbseg.drivers.mcap.pairing import Kind, StampedPair, StampPairing
from nurbseg.drivers.mcap.topics import Topics, TopicSample, choose_topics, recorded_cameras
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: How far a recording is searched for its topics, in its own time.
_SCAN_NS = 2_000_000_000
#: Frames between two places that are remembered for going back.
_PLACE_FRAMES = 10


class _Place(NamedTuple):
    """Where reading can begin with a frame, as nothing read before belongs to it or to a later one."""

    frame: int
    entry: int  # of the file
    passed: int  # messages of this entry that came before
    dropped: int


class RecordingReader(FrameSource):
    """Replays an MCAP recording with ROS 2 ``sensor_msgs``.

    Depth (Image 16UC1 in millimetres or 32FC1 in metres, CompressedImage ``compressedDepth``), color (Image
    or CompressedImage), ground-truth labels, CameraInfo and transforms are found by schema and encoding.
    Depth and color are paired by stamp; a frame's time is its depth image's. A recording that is cut
    off is replayed up to its last whole frame, with a warning.

    Parameters
    ----------
    path : Path
        The file.
    options : SourceOptions
        Calibration or intrinsics that count before the recording's, depth scale, association limit.

    Attributes
    ----------
    dropped : int
        Images left out so far because they had no partner.

    Raises
    ------
    RecordingFormatError
        If it is not such a recording, or holds no whole frame.
    CalibrationError
        If it has no calibration, or an unusable one.
    """

    seekable = True

    def __init__(self, path: Path, options: SourceOptions) -> None:
        super().__init__()
        self._path = path
        self._units_per_metre = options.depth_scale
        #: Why messages of a schema cannot be decoded, "" where they can.
        self._complaints: dict[int, str] = {}
        self._limit_ns = round(options.association_limit_s * 1e9)
        self._pairing = StampPairing(self._limit_ns)
        self._index = 0
        self._position = _Place(0, 0, 0, 0)
        self._places = [self._position]
        self._file = McapFile(path)
        self._is_ours = ros.RECORDING_RECORD in self._file.metadata
        with closed_on_error(self._file.close):
            samples, transforms = self._scan_topics()
            self._topics = topics = self._choose(samples)
            self._kind_of_topic: dict[str, Kind] = {getattr(topics, each): each for each in get_args(Kind)}
            self._schemas = {ros.LABELS_TOPIC: ros.COMPRESSED_IMAGE} | {
                topic: sample.schema for topic, sample in samples.items()
            }
            cameras = options.given_cameras()
            self.calibration = self._calibration(
                cameras or recorded_cameras(path, self._topics, samples, transforms), samples
            )
            self.metadata = self._metadata()
            self._messages = self._file.messages()

    @property
    def dropped(self) -> int:
        """Images left out so far because they had no partner."""
        return self._pairing.dropped

    def _pass_frame(self) -> None:
        self._next_pair()

    def _seek(self, index: int) -> None:
        # A frame that was not read yet takes as long as skipping to it.
        nearest = self._places[bisect_right(self._places, index, key=lambda place: place.frame) - 1]
        if not nearest.frame <= self._index <= index:
            self._begin_at(nearest)
        while self._index < index:
            try:
                self._next_pair()
            except FrameFormatError:
                continue
            except EndOfRecordingError:
                if self._index > 0:
                    self._seek(self._index - 1)
                return

    def _begin_at(self, place: _Place) -> None:
        self._position, self._index = place, place.frame
        self._pairing = StampPairing(self._limit_ns)
        self._pairing.dropped = place.dropped
        self._messages = self._file.messages(first=place.entry)
        for _ in range(place.passed):
            next(self._messages, None)

    def _read(self, timeout_s: float) -> RGBDFrame:
        pair = self._next_pair()
        index = self._index - 1
        topics = self._topics

        def decoded(content: bytes, topic: str) -> tuple[Any, str, str]:
            schema, name = self._schemas[topic], f"{self._path}: frame {index}: {topic}"
            return ros.decode(content, schema, name), schema, name

        depth_mm = ros.depth_of(*decoded(pair.depth, topics.depth), self._units_per_metre)
        color = ros.color_of(*decoded(pair.color, topics.color))
        labels = None
        if pair.labels is not None and topics.labels is not None:
            labels = ros.labels_of(*decoded(pair.labels, topics.labels))
        try:
            return RGBDFrame(
                index=index,
                timestamp_ns=pair.stamp_ns,
                depth_mm=depth_mm,
                color=color,
                calibration=self.calibration,
                labels=labels,
            )
        except ValueError as err:
            raise FrameFormatError(f"{self._path}: frame {index}: {err}") from err

    def _close(self) -> None:
        self._file.close()

    def _next_pair(self) -> StampedPair:
        pair = self._pairing.take()
        while pair is None:
            item = next(self._messages, None)
            if item is not None:
                entry, before = self._file.entry, self._position
                passed = before.passed + 1 if entry == before.entry else 1
                self._position = before._replace(entry=entry, passed=passed)
                if isinstance(item, FrameFormatError):
                    raise item
                self._enter(*item)
            pair = self._pairing.take(at_end=item is None)
            self.metadata["dropped"] = str(self.dropped)
            if item is None and pair is None:
                if self.dropped:
                    _log.warning("%s: %d images had no partner", self._path, self.dropped)
                raise EndOfRecordingError(f"{self._path}: end after {self._index} frames")
        self._index += 1
        if self._index >= self._places[-1].frame + _PLACE_FRAMES and not self._pairing.waiting:
            self._places.append(self._position._replace(frame=self._index, dropped=self.dropped))
        return pair

    def _enter(self, channel: Channel, message: Message) -> None:
        topic, content = channel.topic, message.data
        kind = self._kind_of_topic.get(topic)
        if len(content) < 12 or kind is None:
            return
        stamp_ns = ros.stamp_ns(content)
        if not 0 <= stamp_ns < STAMP_END_NS:
            raise FrameFormatError(f"{self._path}: {topic}: stamp: expected 1970 to 2038, got {stamp_ns} ns")
        self._pairing.add(kind, stamp_ns, content)

    def _is_decodable(self, schema: Schema) -> bool:
        """Whether messages of a schema can be decoded; logs once why not."""
        if schema.id not in self._complaints:
            self._complaints[schema.id] = ""
            try:
                ros.check_schema(schema, str(self._path))
            except RecordingFormatError as err:
                self._complaints[schema.id] = complaint = str(err)
                _log.warning("%s; its messages are skipped", complaint)
        return not self._complaints[schema.id]

    def _scan_topics(self) -> tuple[dict[str, TopicSample], list[ros.Transform]]:
        """Return the first message of each topic and the transforms, of the recording's first seconds."""
        samples: dict[str, TopicSample] = {}
        transforms: list[ros.Transform] = []
        start_ns: int | None = None
        damage: FrameFormatError | None = None
        # Messages of any number of topics are kept decoded, and transforms take time.
        left = {False: SAMPLES_BYTES_MAX, True: TRANSFORMS_BYTES_MAX}
        for item in self._file.messages(SCAN_BYTES_MAX):
            if isinstance(item, FrameFormatError):
                damage = damage or item
                continue
            channel, message = item
            start_ns = message.log_time if start_ns is None else start_ns
            # Our own recordings say everything with the first frame.
            if self._is_ours and ros.DEPTH_TOPIC in samples:
                break
            if message.log_time - start_ns > _SCAN_NS and self._has_images(samples):
                break
            topic = channel.topic
            schema = self._file.schemas.get(channel.schema_id)
            if schema is None or schema.name not in ros.DEFINITIONS or channel.message_encoding != "cdr":
                continue
            is_transform = schema.name == ros.TRANSFORMS
            if (topic in samples and not is_transform) or not self._is_decodable(schema):
                continue
            left[is_transform] -= len(message.data)
            if left[is_transform] < 0:
                continue
            try:
                decoded = ros.decode(message.data, schema.name, f"{self._path}: {topic}")
            except FrameFormatError:
                continue
            if is_transform:
                transforms += ros.transforms_of(decoded)
            samples.setdefault(topic, TopicSample(schema.name, decoded))
        if damage is not None and start_ns is None:
            raise RecordingFormatError(f"{damage}; no message can be read")
        return samples, transforms

    def _has_images(self, samples: dict[str, TopicSample]) -> bool:
        try:
            topics = choose_topics(self._path, samples)
        except RecordingFormatError:
            return False
        return topics.depth_info is not None or topics.color_info is not None

    def _choose(self, samples: dict[str, TopicSample]) -> Topics:
        if not samples and not self._file.whole:
            raise RecordingFormatError(f"{self._path}: the recording is cut off before its first frame")
        try:
            topics = choose_topics(self._path, samples)
            if topics.labels is None and self._is_ours:
                # Perhaps later frames have ground truth.
                topics = replace(topics, labels=ros.LABELS_TOPIC)
            return topics
        except RecordingFormatError as err:
            if complaint := next(filter(None, self._complaints.values()), ""):
                raise RecordingFormatError(f"{err}; {complaint}") from err
            if self._file.whole:
                raise
            raise RecordingFormatError(f"{err}; the recording is cut off, perhaps before them") from err

    def _calibration(self, cameras: CameraFile, samples: dict[str, TopicSample]) -> Calibration:
        """Return the calibration for the sizes of the images that there are."""
        topics, name = self._topics, str(self._path)
        depth, color = samples[topics.depth], samples[topics.color]
        try:
            depth_shape = ros.depth_of(depth.message, depth.schema, name).shape
            color_shape = ros.color_of(color.message, color.schema, name).shape
        except FrameFormatError:
            # The first image is damaged; CameraInfo has the sizes.
            return cameras.calibration()
        return cameras.calibration(
            depth_size=(depth_shape[1], depth_shape[0]), color_size=(color_shape[1], color_shape[0])
        )

    def _metadata(self) -> dict[str, str]:
        metadata = dict(self._file.metadata.get(ros.DEVICE_RECORD, {}))
        metadata["format"] = "MCAP recording"
        metadata["dropped"] = "0"
        metadata["whole"] = str(self._file.whole).lower()
        for number, channel in self._file.channels.items():
            if channel.topic == self._topics.depth and number in self._file.message_counts:
                metadata["frames"] = str(self._file.message_counts[number])
        return metadata
