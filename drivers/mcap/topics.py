"""Finds which topics of a recording are the depth images, the color images, their cameras and labels."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.errors import CalibrationError, RecordingFormatError
from nurbseg.drivers.mcap import messages as ros
from nurbseg.drivers.mcap.pairing import Kind

_EXPECTED: dict[Kind, str] = {
    "depth": "Image 16UC1 or 32FC1, or CompressedImage compressedDepth",
    "color": "Image rgb8, bgr8 or mono8, or CompressedImage jpeg or png",
}


@dataclass(frozen=True, slots=True)
class TopicSample:
    """The first message of a topic, decoded, and the name of its schema."""

    schema: str
    message: Any


@dataclass(frozen=True, slots=True)
class Topics:
    """The topics that are replayed; `labels` and the cameras may be missing."""

    depth: str
    color: str
    labels: str | None
    depth_info: str | None
    color_info: str | None


def choose_topics(path: Path, samples: Mapping[str, TopicSample]) -> Topics:
    """Choose the topics by schema and encoding of their first messages, and by name where there are several.

    Raises RecordingFormatError if there are no depth or no color images; says which topics there are.
    """
    found: dict[Kind | None, list[str]] = {"depth": [], "color": [], "labels": []}
    for topic, sample in samples.items():
        found.setdefault(_kind(topic, sample), []).append(topic)
    for kind, expected in _EXPECTED.items():
        if not found[kind]:
            present = ", ".join(f"{t} ({_form(sample)})" for t, sample in samples.items()) or "none"
            raise RecordingFormatError(f"{path}: no topic of {kind} images ({expected}); topics: {present}")
    depth = min(
        found["depth"], key=lambda topic: (_rank(topic, ("aligned", "registered"), ("depth",)), topic)
    )
    color = min(found["color"], key=lambda topic: (_rank(topic, ("color", "rgb"), ("image",)), topic))
    return Topics(
        depth=depth,
        color=color,
        labels=min(found["labels"], default=None),
        depth_info=_camera_topic(depth, samples),
        color_info=_camera_topic(color, samples),
    )


def recorded_cameras(
    path: Path,
    topics: Topics,
    samples: Mapping[str, TopicSample],
    transforms: list[ros.Transform],
) -> CameraFile:
    """Return the cameras of the recording itself.

    One CameraInfo stands for both cameras, the images being registered. Raises CalibrationError if there is
    no CameraInfo, an unusable one, or no transform between two cameras.
    """
    present = [info for info in (topics.depth_info, topics.color_info) if info is not None]
    if not present:
        raise CalibrationError(
            f"{path}: no sensor_msgs/CameraInfo beside {topics.depth} or {topics.color}: "
            "give --intrinsics fx,fy,cx,cy (pixels)"
        )
    depth, color = (ros.camera_of(samples[info].message, path, info) for info in (present[0], present[-1]))
    depth_frame, color_frame = (_frame_id(samples[info]) for info in (present[0], present[-1]))
    if present[0] == present[-1] or depth_frame == color_frame:
        same = depth.size == color.size and np.array_equal(depth.matrix, color.matrix)
        same = same and np.array_equal(depth.distortion, color.distortion)
        return CameraFile(path=path, depth=depth, color=depth if same else color)
    transform = _transform(color_frame, depth_frame, transforms)
    if transform is None:
        raise CalibrationError(
            f"{path}: no transform from {depth_frame!r} to {color_frame!r} in a tf2_msgs/TFMessage: "
            "give --intrinsics fx,fy,cx,cy if depth is registered to color"
        )
    return CameraFile(path=path, depth=depth, color=color, color_from_depth=transform)


def _form(sample: TopicSample) -> str:
    encoding = getattr(sample.message, "encoding", None) or getattr(sample.message, "format", None)
    name = sample.schema.rpartition("/")[2]
    return f"{name} {encoding}" if encoding else name


def _kind(topic: str, sample: TopicSample) -> Kind | None:
    """Return what the images of a topic are; None where it has none that can be used."""
    name = topic.lower()
    for_labels = "label" in name or "segmentation" in name
    is_labels = is_depth = is_color = False
    if sample.schema == ros.COMPRESSED_IMAGE:
        text = sample.message.format.lower()
        is_labels = for_labels and "png" in text
        is_depth = "compressedDepth" in sample.message.format
        is_color = any(each in text for each in ("jpeg", "jpg", "png"))
        is_color &= not text.startswith(("16uc1", "32fc1"))
    elif sample.schema == ros.IMAGE:
        encoding = sample.message.encoding
        is_labels = for_labels and encoding in ros.LABEL_ENCODINGS
        # An infrared image is "mono16" too.
        is_depth = encoding in ("16UC1", "32FC1") or (encoding == "mono16" and "depth" in name)
        is_color = encoding in ros.COLOR_ENCODINGS
    return "labels" if is_labels else "depth" if is_depth else "color" if is_color else None


def _rank(topic: str, *wanted: tuple[str, ...]) -> int:
    for rank, words in enumerate(wanted):
        if any(word in topic.lower() for word in words):
            return rank
    return len(wanted)


def _frame_id(sample: TopicSample) -> str:
    return str(sample.message.header.frame_id).lstrip("/")


def _camera_topic(topic: str, samples: Mapping[str, TopicSample]) -> str | None:
    """Return the CameraInfo topic beside an image topic, else the one with the same frame."""
    infos = [each for each, sample in samples.items() if sample.schema == ros.CAMERA_INFO]
    parts = topic.split("/")
    for depth in range(len(parts) - 1, 1, -1):
        beside = "/".join([*parts[:depth], "camera_info"])
        if beside in infos:
            return beside
    frame = _frame_id(samples[topic])
    return next((info for info in infos if frame and _frame_id(samples[info]) == frame), None)


def _transform(target: str, source: str, transforms: list[ros.Transform]) -> NDArray[np.float64] | None:
    """Return target_from_source, chained from a tree of transforms."""
    steps: dict[str, list[tuple[str, NDArray[np.float64]]]] = {}
    for parent, child, matrix in transforms:
        steps.setdefault(child, []).append((parent, matrix))
        steps.setdefault(parent, []).append((child, np.asarray(np.linalg.inv(matrix), dtype=np.float64)))
    reached = {source: np.eye(4)}
    waiting = [source]
    while waiting:
        frame = waiting.pop()
        for other, other_from_frame in steps.get(frame, []):
            if other not in reached:
                reached[other] = other_from_frame @ reached[frame]
                waiting.append(other)
    return reached.get(target)
