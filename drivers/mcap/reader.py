"""Replays recordings: MCAP files of ROS 2 messages, our own and others'."""

import logging
from bisect import bisect_right
from contextlib import ExitStack
from pathlib import Path
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
from nurbseg.drivers.datasets.images import GRAY
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.calibrations import Calibrations
from nurbseg.drivers.mcap.clocks import Clocks, StampRepair, lateness
from nurbseg.drivers.mcap.container.bag import MessageFile, later_part, parts_before, parts_in
from nurbseg.drivers.mcap.container.timeline import Logged, Timeline
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.pairing import Kind, StampedPair, StampPairing
from nurbseg.drivers.mcap.scan import Scan, open_bag_file, other_messages
from nurbseg.drivers.mcap.topics import Topics, choose_topics
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: Frames between two places that are remembered for going back.
_PLACE_FRAMES = 10
#: Depth images, and bytes of messages, whose stamps and log times are compared at first.
_COMPARED, _COMPARED_BYTES = 45, 1 << 26
#: One image may be logged so much later than the other, nanoseconds, and is read in that order.
_LATE_NS = 500_000_000
#: As long as the stamp of a message and what comes before it.
_STAMP_BYTES = 12


class _Place(NamedTuple):
    """Where reading can begin with a frame, as nothing read before belongs to it or to a later one."""

    frame: int
    number: int  # of the next message
    dropped: int


class RecordingReader(FrameSource):
    """Replays an MCAP recording with ROS 2 ``sensor_msgs``, a ``.db3``, or a bag of several such files.

    Depth (Image 16UC1 in millimeters or 32FC1 in meters, CompressedImage ``compressedDepth``), color (Image
    or CompressedImage), ground-truth labels, CameraInfo and transforms are found by schema and encoding;
    where there is no color it is gray. Messages are read in the order in which they were logged. Depth and
    color are paired by stamp, and a frame's time is its depth image's stamp, or both by the times of the log
    where stamps make no sense (``metadata["clock"]``). A recording that is cut off is replayed up to its last
    whole frame, with a warning. Labels that cannot be used are left out.

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
        self._index = 0
        self._places = [_Place(0, 0, 0)]
        self._position = 0
        self._labels_lost = 0
        self._files: list[MessageFile] = []
        with closed_on_error(self.close):
            for part in parts_in(path) if path.is_dir() else [path]:
                self._files.append(open_bag_file(part))
            scan = Scan(self._files)
            self.samples = scan.samples
            self._calibrations = self._calibrated(scan, options)
            self.topics = topics = self._calibrations.topics
            self._kind_of_topic: dict[str, Kind] = {getattr(topics, each): each for each in get_args(Kind)}
            self._is_ours = is_ours = all(ros.RECORDING_RECORD in file.metadata for file in self._files)
            topics_read = set(filter(None, (topics.depth_info, topics.color_info, *self._kind_of_topic)))
            self._motion = None
            if ros.POSE_TOPIC in self.samples or ros.IMU in {each.schema for each in self.samples.values()}:
                from nurbseg.drivers.mcap.bags.motion import RecordedMotion  # late: most have neither

                self._motion = RecordedMotion(
                    topics.depth, scan.samples, scan.find_transform, is_ours=is_ours
                )
                topics_read |= self._motion.topics
            self.timeline = Timeline(self._files, topics_read, in_order=is_ours)
            self._calibrations.timeline = self.timeline
            self._schemas = {ros.LABELS_TOPIC: ros.COMPRESSED_IMAGE} | {
                topic: sample.schema for topic, sample in self.samples.items()
            }
            self.depth_unit = self._unit_in_force = self._unit(scan, options)
            self.clocks = self._choose_clocks()
            self.calibration = self._calibrations.first()
            self._pairing = self._new_pairing()
            self.metadata = self._metadata()
            self._messages = self.timeline.messages()

    def __len__(self) -> int:
        return len(self.timeline.numbers(self.topics.depth))

    @property
    def dropped(self) -> int:
        """Images left out so far because they had no partner."""
        return self._pairing.dropped

    def _new_pairing(self) -> StampPairing:
        # Ours log labels first, and not of every frame.
        late_labels = self.topics.labels is not None and not self._is_ours
        return StampPairing(self._limit_ns, color=self.topics.color is not None, labels=late_labels)

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
        self._position, self._index = place.number, place.frame
        self._pairing = self._new_pairing()
        self._pairing.dropped = place.dropped
        self._messages = self.timeline.messages(first=place.number)

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
                labels = None
                self._lose_labels(err)
        has_one_clock = self.clocks.times == self.clocks.pairs
        try:
            calibration = self._calibrations.at(pair, depth_mm.shape, color.shape, index)
            pose, down = self._motion.at(self.timeline, pair, calibration) if self._motion else (None, None)
            return RGBDFrame(
                index=index,
                timestamp_ns=pair.stamp_ns if has_one_clock else int(self.timeline.times_ns[pair.number]),
                depth_mm=depth_mm,
                color=color,
                calibration=calibration,
                labels=labels,
                world_from_camera=pose,
                gravity=down,
            )
        except (ValueError, CalibrationError) as err:
            text = str(err).removeprefix(f"{self._path}: ")
            raise FrameFormatError(f"{name}: {text}") from err

    def _lose_labels(self, err: FrameFormatError) -> None:
        self._labels_lost += 1
        self.labels_fault = str(err)
        self.metadata["labels_lost"] = str(self._labels_lost)
        if self._labels_lost == 1:
            _log.warning("%s; frames whose labels cannot be used are replayed without them", err)

    def _close(self) -> None:
        with ExitStack() as stack:
            for file in self._files:
                stack.callback(file.close)

    def _next_pair(self) -> StampedPair:
        pair = self._pairing.take()
        while pair is None:
            item = next(self._messages, None)
            if isinstance(item, FrameFormatError):
                raise item
            if item is not None:
                self._position = item.number + 1
                self._enter(item)
            pair = self._pairing.take(at_end=item is None)
            self.metadata["dropped"] = str(self.dropped)
            if item is None and pair is None:
                if self.dropped:
                    _log.warning("%s: %d images had no partner", self._path, self.dropped)
                if unused := self._pairing.unused_labels:
                    _log.warning("%s: %d label images have the time of no frame", self._path, unused)
                raise EndOfRecordingError(f"{self._path}: end after {self._index} frames")
        self._index += 1
        if self._index >= self._places[-1].frame + _PLACE_FRAMES and not self._pairing.waiting:
            self._places.append(_Place(self._index, self._position, self.dropped))
        return pair

    def _enter(self, item: Logged) -> None:
        topic, content = item.channel.topic, item.message.data
        kind = self._kind_of_topic.get(topic)
        if len(content) < _STAMP_BYTES or kind is None:
            return
        log_ns = int(self.timeline.times_ns[item.number])
        time_ns = log_ns
        if self.clocks.pairs == "stamp" and self.clocks.times == "log":
            time_ns = ros.stamp_ns(content)
        elif self.clocks.pairs == "stamp":
            stamp, before = ros.stamp_fields(content), self._repair.replaced
            time_ns = self._repair.stamp(kind, *stamp, log_ns)
            if self._repair.replaced > before:
                self.metadata["stamps_replaced"] = str(self._repair.replaced)
                if self._repair.replaced == 1:
                    how = "is wrong; the log's time stands in for such stamps"
                    _log.warning("%s: %s: the stamp %d.%09d s %s", self._path, named(topic), *stamp, how)
        self._pairing.add(kind, time_ns, content, item.number)

    def _chosen(self, scan: Scan, options: SourceOptions) -> list[Topics]:
        """Return the cameras that can be replayed, the best first."""
        cut_off = not all(file.whole for file in self._files)
        if not scan.samples and cut_off and not (other := other_messages(self._files)):
            raise RecordingFormatError(f"{self._path}: the recording is cut off before its first frame")
        try:
            return choose_topics(self._path, scan.samples, options.depth_topic, options.color_topic)
        except RecordingFormatError as err:
            complaint = next(filter(None, scan.complaints.values()), "")
            if other := complaint or other_messages(self._files):
                raise RecordingFormatError(f"{err}; {other}") from err
            if not cut_off:
                raise
            raise RecordingFormatError(f"{err}; the recording is cut off, perhaps before them") from err

    def _calibrated(self, scan: Scan, options: SourceOptions) -> Calibrations:
        """Choose the camera that is replayed; the first part of a split bag may have to say where it is."""
        try:
            return Calibrations(self._path, self._chosen(scan, options), scan, options)
        except CalibrationError as err:
            before = [] if self._path.is_dir() else parts_before(self._path)
            if not before:
                raise CalibrationError(f"{err}{later_part(self._path)}") from err
            scan.learn_from(before[0])
            found = Calibrations(self._path, self._chosen(scan, options), scan, options)
            _log.warning("%s: its cameras are described by %s, the first part", self._path, before[0])
            return found

    def _unit(self, scan: Scan, options: SourceOptions) -> DepthUnit:
        sample = self.samples[self.topics.depth]
        try:
            depth = images.raw_depth(sample.message, sample.schema, self.topics.depth, str(self._path))
            self._is_float = depth.dtype == np.float32
        except FrameFormatError:
            # The first image is damaged.
            form = getattr(sample.message, "encoding", "") or getattr(sample.message, "format", "")
            self._is_float = form.upper().startswith("32FC1")
        stated: DepthUnit | None = None
        convention = DepthUnit(1.0, "ROS REP 118: 32FC1 is in meters")
        if not self._is_float:
            stated = self._calibrations.depth_unit or scan.stated_unit()
            convention = DepthUnit(1000.0, "ROS REP 118: 16UC1 is in millimeters")
        return decided_unit(options.depth_scale, stated, convention)

    def _choose_clocks(self) -> Clocks:
        """Compare stamps and log times of the first images."""
        found: dict[Kind, list[tuple[int, int]]] = {"depth": [], "color": []}
        left = _COMPARED_BYTES
        depth = self.timeline.numbers(self.topics.depth)[:_COMPARED]
        color = self.timeline.numbers(self.topics.color or "")
        # Those of the same time, and the first ones: they may be logged later or begin at another time.
        same = int(np.searchsorted(color, depth[0])) if depth.size else 0
        color = np.concatenate([color[:_COMPARED], color[same : same + 2 * _COMPARED]])
        for item in self.timeline.messages(np.unique(np.concatenate([depth, color]))):
            if isinstance(item, FrameFormatError):
                continue
            left -= len(item.message.data)
            if left < 0:
                break
            if len(item.message.data) >= _STAMP_BYTES:
                kind: Kind = "depth" if item.channel.topic == self.topics.depth else "color"
                log_ns = int(self.timeline.times_ns[item.number])
                found[kind].append((ros.stamp_ns(item.message.data), log_ns))
        clocks = Clocks.choose(found["depth"], found["color"], self._limit_ns)
        if clocks.reasons:
            _log.warning("%s: %s", self._path, clocks)
        self._repair = StampRepair.learned(found)
        if clocks.pairs == "stamp" and self.topics.color is not None:
            late_ns = lateness(found["depth"], found["color"])
            if abs(late_ns) > _LATE_NS:
                # So many would wait for their partners that they were dropped.
                self.timeline.undelay(self.topics.color if late_ns > 0 else self.topics.depth, abs(late_ns))
        return clocks

    def _metadata(self) -> dict[str, str]:
        metadata: dict[str, str] = {}
        for file in self._files:
            metadata |= file.metadata.get(ros.DEVICE_RECORD, {})
        whole = str(all(file.whole for file in self._files)).lower()
        metadata |= {"format": self._files[0].form, "dropped": "0", "whole": whole, "frames": str(len(self))}
        metadata["depth_topic"], metadata["color_topic"] = self.topics.depth, self.topics.color or "none"
        metadata["depth_unit"] = str(self.depth_unit)
        metadata["clock"] = str(self.clocks)
        if self.timeline.note:
            metadata["order"] = self.timeline.note
            _log.warning("%s: %s", self._path, self.timeline.note)
        return metadata
