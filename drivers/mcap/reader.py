"""Replays recordings: MCAP files of ROS 2 messages, our own and others'."""

import logging
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, get_args

import numpy as np

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import (
    CalibrationError,
    EndOfRecordingError,
    FrameFormatError,
    RecordingFormatError,
    named,
)
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.limits import STAMP_END_NS
from nurbseg.drivers.datasets.images import GRAY
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.cameras import Calibrations
from nurbseg.drivers.mcap.container.messages import Logged
from nurbseg.drivers.mcap.container.parts import later_part, open_messages
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.motion import RecordedMotion
from nurbseg.drivers.mcap.pairing import Beside, Kind, StampedPair, StampPairing
from nurbseg.drivers.mcap.scan import Scan
from nurbseg.drivers.mcap.topics import choose_topics
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: Most places that are remembered for going back: of every frame at first, then of ever fewer.
_PLACES_MAX = 4096
#: The first images whose stamps choose the clock, and the bytes that are read for it.
_COMPARED, _COMPARED_BYTES = 90, 1 << 26
#: As long as the stamp of a message and what comes before it.
_STAMP_BYTES = 12


class _Place(NamedTuple):
    """Where reading can begin with a frame, as nothing read before belongs to it or to a later one."""

    frame: int = 0
    dropped: int = 0
    after: Any = None
    beside: Mapping[str, tuple[int, bytes]] = MappingProxyType({})


class RecordingReader(FrameSource):
    """Replays an MCAP recording with ROS 2 ``sensor_msgs``, a ``.db3``, or a bag of several such files.

    Depth (Image 16UC1 in millimeters or 32FC1 in meters, CompressedImage ``compressedDepth``), color (Image
    or CompressedImage), ground-truth labels, CameraInfo and transforms are found by schema and encoding;
    where there is no color it is gray. Messages are read in the order in which they were logged. Depth and
    color are paired by stamp, and a frame's time is its depth image's stamp, or both by the times of the log
    where the stamps are 0 or go back (``metadata["clock"]``). A recording that is cut off is replayed up to
    its last whole frame, with a warning. Labels that cannot be used are left out.

    Parameters
    ----------
    path : Path
        The file, or the folder of a bag that was split.
    options : SourceOptions
        Topics, calibration or intrinsics that count before the recording's, depth scale, association limit.

    Attributes
    ----------
    samples : dict of str to TopicSample
        The first message of each topic.
    topics : Topics
        Those that are replayed.

    Raises
    ------
    RecordingFormatError
        If it is not such a recording, has no depth images, or not the topics that `options` name.
    CalibrationError
        If it has no calibration, or an unusable one.
    """

    seekable = True

    def __init__(self, path: Path, options: SourceOptions) -> None:
        super().__init__()
        self._path = path
        self._limit_ns = round(options.association_limit_s * 1e9)
        self._labels_lost = 0
        self._recording = open_messages(path)
        with closed_on_error(self.close):
            scan = Scan(self._recording)
            self.samples = scan.samples
            self._calibrations = self._calibrated(scan, options)
            self.topics = topics = self._calibrations.topics
            self._kind_of_topic: dict[str, Kind] = {
                topic: each for each in get_args(Kind) if (topic := getattr(topics, each)) is not None
            }
            self._is_ours = is_ours = ros.RECORDING_RECORD in self._recording.metadata
            self._motion = RecordedMotion(topics.depth, scan.samples, scan.find_transform, is_ours=is_ours)
            self._topics_beside = self._calibrations.info_topics | self._motion.topics
            self._schemas = {ros.LABELS_TOPIC: ros.COMPRESSED_IMAGE} | {
                topic: sample.schema for topic, sample in self.samples.items()
            }
            self.depth_unit = self._unit_in_force = self._unit(scan, options)
            self._clock_fault = self._fault_of_stamps()
            if self._clock_fault:
                _log.warning("%s: images are paired and timed by the log (%s)", path, self._clock_fault)
            self.calibration = self._calibrations.first
            self._places, self._place_frames = [_Place()], 1
            self._begin_at(self._places[0])
            self.metadata = self._metadata()

    def __len__(self) -> int:
        return self._recording.topics[self.topics.depth].messages

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
        self._index = self._paired = place.frame
        self._found: deque[StampedPair | FrameFormatError] = deque()
        self._at_end = False
        # Ours log labels first, and not of every frame.
        late_labels = self.topics.labels is not None and not self._is_ours
        has_color = self.topics.color is not None
        self._pairing = StampPairing(self._limit_ns, color=has_color, labels=late_labels)
        self._pairing.dropped = place.dropped
        self._beside = Beside(self._topics_beside, place.beside)
        topics = self._kind_of_topic.keys() | self._topics_beside
        self._messages = self._recording.messages(sorted(topics), place.after)

    def _read(self, timeout_s: float) -> RGBDFrame:
        pair = self._next_pair()
        index = self._index - 1
        topics, name = self.topics, f"{self._path}: frame {index}"

        def decoded(content: bytes, topic: str) -> tuple[Any, str, str]:
            where, schema = f"{name}: {named(topic)}", self._schemas[topic]
            return ros.decode(content, schema, where), schema, where

        message, schema, where = decoded(pair.depth, topics.depth)
        depth = images.raw_depth(message, schema, topics.depth, where)
        if (depth.dtype == np.float32) != self._is_float:
            raise FrameFormatError(f"{where}: the type of depth changes to {depth.dtype}")
        depth_mm = self._unit_in_force.millimeters(depth)
        if topics.color is None or pair.color is None:
            color = np.full((*depth_mm.shape, 3), GRAY, np.uint8)
        else:
            color = images.color_of(*decoded(pair.color, topics.color))
        labels, self.labels_fault = None, ""
        if pair.labels is not None and topics.labels is not None:
            try:
                labels = images.labels_of(*decoded(pair.labels, topics.labels))
                if labels.shape != depth_mm.shape:
                    where = f"{name}: {named(topics.labels)}"
                    raise FrameFormatError(f"{where}: expected {depth_mm.shape} labels, got {labels.shape}")
            except FrameFormatError as err:
                labels, self.labels_fault = None, str(err)
                self._labels_lost += 1
                self.metadata["labels_lost"] = str(self._labels_lost)
                if self._labels_lost == 1:
                    _log.warning("%s; frames whose labels cannot be used are replayed without them", err)
        try:
            calibration = self._calibrations.at(pair, self._beside, depth_mm.shape, color.shape, index)
            return RGBDFrame(
                index=index,
                timestamp_ns=pair.time_ns,
                depth_mm=depth_mm,
                color=color,
                calibration=calibration,
                labels=labels,
                world_from_camera=self._motion.pose(self._beside, pair, calibration),
                gravity=self._motion.gravity(self._beside, pair),
            )
        except (ValueError, CalibrationError) as err:
            text = str(err).removeprefix(f"{self._path}: ")
            raise FrameFormatError(f"{name}: {text}") from err

    def _close(self) -> None:
        self._recording.close()

    def _next_pair(self) -> StampedPair:
        # One more is read, as what belongs to a frame may be logged after it.
        while len(self._found) < 2 and not self._at_end:
            self._advance()
        if not self._found:
            raise EndOfRecordingError(f"{self._path}: end after {self._index} frames")
        pair = self._found.popleft()
        if isinstance(pair, FrameFormatError):
            raise pair
        self._index += 1
        return pair

    def _advance(self) -> None:
        """Read one message."""
        item = next(self._messages, None)
        self._at_end = item is None
        if isinstance(item, FrameFormatError):
            self._found.append(item)
        elif item is not None:
            self._enter(item)
        while (pair := self._pairing.take(at_end=self._at_end)) is not None:
            self._paired += 1
            self._found.append(pair)
        self.metadata["dropped"] = str(self.dropped)
        if isinstance(item, Logged):
            if self._paired >= self._places[-1].frame + self._place_frames and not self._pairing.waiting:
                place = _Place(self._paired, self.dropped, item.after, self._beside.newest)
                self._places.append(place)
                if len(self._places) > _PLACES_MAX:
                    del self._places[1::2]
                    self._place_frames *= 2
        elif self._at_end:
            if self.dropped:
                _log.warning("%s: %d images had no partner", self._path, self.dropped)
            if unused := self._pairing.unused_labels:
                _log.warning("%s: %d label images have the time of no frame", self._path, unused)

    def _enter(self, item: Logged) -> None:
        if len(item.content) < _STAMP_BYTES:
            return
        if item.topic in self._topics_beside:
            self._beside.add(item.topic, item.log_ns, item.content)
        if (kind := self._kind_of_topic.get(item.topic)) is not None:
            self._pairing.add(kind, self._time_ns(item), item.content, item.log_ns)

    def _time_ns(self, item: Logged) -> int:
        """Return the time that a message is paired by, nanoseconds."""
        stamp_ns = ros.stamp_ns(item.content)
        is_stamped = not self._clock_fault and 0 < stamp_ns < STAMP_END_NS
        return stamp_ns if is_stamped else min(item.log_ns, STAMP_END_NS - 1)

    def _calibrated(self, scan: Scan, options: SourceOptions) -> Calibrations:
        """Return the calibration of the best camera that can be replayed."""
        try:
            cameras = choose_topics(self._path, scan.samples, options.depth_topic, options.color_topic)
        except RecordingFormatError as err:
            cut_off = "" if self._recording.whole else "the recording is cut off, perhaps before them"
            raise RecordingFormatError("; ".join(filter(None, (str(err), scan.unread() or cut_off)))) from err
        try:
            return Calibrations(self._path, cameras, scan, options)
        except CalibrationError as err:
            raise CalibrationError(f"{err}{later_part(self._path)}") from err

    def _unit(self, scan: Scan, options: SourceOptions) -> DepthUnit:
        sample = self.samples[self.topics.depth]
        try:
            depth = images.raw_depth(sample.message, sample.schema, self.topics.depth, str(self._path))
            self._is_float = depth.dtype == np.float32
        except FrameFormatError:
            # The first image is damaged.
            self._is_float = sample.encoding.upper().startswith("32FC1")
        stated: DepthUnit | None = None
        convention = DepthUnit(1.0, "ROS REP 118: 32FC1 is in meters")
        if not self._is_float:
            stated = self._calibrations.depth_unit or scan.stated_unit()
            convention = DepthUnit(1000.0, "ROS REP 118: 16UC1 is in millimeters")
        return decided_unit(options.depth_scale, stated, convention)

    def _fault_of_stamps(self) -> str:
        """Return why images are not paired by their stamps, as the first of them show; "" if they are."""
        left = _COMPARED_BYTES
        times: dict[str, list[tuple[int, int]]] = {"depth": [], "color": []}
        kinds = {topic: each for topic, each in self._kind_of_topic.items() if each in times}
        for item in islice(self._recording.messages(kinds), _COMPARED):
            if isinstance(item, FrameFormatError) or len(item.content) < _STAMP_BYTES:
                continue
            left -= len(item.content)
            if left < 0:
                break
            times[kinds[item.topic]].append((ros.stamp_ns(item.content), item.log_ns))
        for kind, found in times.items():
            stamps_ns, logs_ns = np.array(found, np.int64).reshape(-1, 2).T
            is_stamped = (stamps_ns > 0) & (stamps_ns < STAMP_END_NS)
            if np.count_nonzero(is_stamped) < stamps_ns.size / 2:
                return f"the stamps of {kind} are 0, or out of range"
            steps_ns, log_steps_ns = np.diff(stamps_ns), np.diff(logs_ns)
            stand_still = steps_ns.size > 1 and not steps_ns.any() and log_steps_ns.any()
            if stand_still or ((steps_ns < 0).any() and not (log_steps_ns < 0).any()):
                return f"the stamps of {kind} go back, or stand still"
        return ""

    def _metadata(self) -> dict[str, str]:
        recording = self._recording
        return recording.metadata.get(ros.DEVICE_RECORD, {}) | {
            "format": recording.form,
            "dropped": "0",
            "whole": str(recording.whole).lower(),
            "frames": str(len(self)),
            "depth_topic": self.topics.depth,
            "color_topic": self.topics.color or "none",
            "depth_unit": str(self.depth_unit),
            "clock": f"log times ({self._clock_fault})" if self._clock_fault else "stamps",
        }
