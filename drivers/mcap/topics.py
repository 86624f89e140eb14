"""Finds which topics of a recording are the depth images, the color images, their cameras and labels."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from nurbseg.common.errors import RecordingFormatError, listed, named
from nurbseg.drivers.calibration.foreign import is_image
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.pairing import Kind

_EXPECTED = "Image 16UC1 or 32FC1, or CompressedImage compressedDepth"
_EXPECTED_COLOR = "Image rgb8, bgr8 or mono8, or CompressedImage jpeg or png"
#: Words of a topic's name that say what its images are, not whose.
_NUMBERED = re.compile(r"(depth|colou?r|rgb|infra|ir|sensor)\d*", re.IGNORECASE)
_WORDS = frozenset(("aligned", "registered", "to", "image", "raw", "rect", "stereo", "camera"))
_OF_SENSOR = re.compile(r"depth|colou?r|rgb|infra|\bir\b|_ir\b|\bir_", re.IGNORECASE)
_INFRARED = re.compile(r"infra|\bir\b|_ir\b|\bir_", re.IGNORECASE)
#: Names of images that have an encoding of depth but are something else, unless they say depth, too.
_OTHER = re.compile(
    rf"{_INFRARED.pattern}|disparity|confidence|thermal|intensity|amplitude|normals|mask|semantic",
    re.IGNORECASE,
)
#: Rectified by ROS's own words for it; RealSense's "rect_raw" is named so whatever its distortion is.
_RECTIFIED = re.compile(r"(^|[_/])rect(ified)?(?!_raw)(_|/|$)", re.IGNORECASE)
#: Names that simulators give to distances along rays, and what is wrong with these.
_DISTANCES = re.compile(
    r"distance_to_camera|radial_distance|depth_?perspective|depth_euclidean", re.IGNORECASE
)
ALONG_RAYS = (
    "by its name the distance along each pixel's ray, not depth along the camera's axis; divide it by "
    "sqrt(((column - cx) / fx)^2 + ((row - cy) / fy)^2 + 1), and save it under another name"
)


@dataclass(frozen=True, slots=True)
class TopicSample:
    """The first message of a topic, decoded, and the name of its schema."""

    schema: str
    message: Any


@dataclass(frozen=True, slots=True)
class Topics:
    """The topics that are replayed; `color`, `labels` and the cameras may be missing."""

    depth: str
    color: str | None
    labels: str | None
    depth_info: str | None
    color_info: str | None


def choose_topics(
    path: Path, samples: Mapping[str, TopicSample], depth: str | None = None, color: str | None = None
) -> list[Topics]:
    """Return the cameras that there are, the best first, by schema and encoding of their first messages.

    Depth never goes with the color of another camera: they share the name before what says what they are, or
    the frame. Depth that is registered to color comes first. Without color of its camera depth is by itself.
    `depth` and `color` are topics that the user wants. Raises RecordingFormatError if there is no depth, or
    no such topic; says which topics there are.
    """
    found: dict[Kind | None, list[str]] = {"depth": [], "color": [], "labels": []}
    for topic, sample in samples.items():
        found.setdefault(_kind(topic, sample, is_wanted=topic == depth), []).append(topic)
    depths = found["depth"]
    for kind, wanted, flag, expected in (
        ("depth", depth, "--depth-topic", _EXPECTED),
        ("color", color, "--color-topic", _EXPECTED_COLOR),
    ):
        if wanted is None:
            continue
        if wanted not in found[kind]:  # type: ignore[index]
            what = "no such topic" if wanted not in samples else f"not {kind} images ({expected})"
            what = ALONG_RAYS if wanted in samples and kind == "depth" and _DISTANCES.search(wanted) else what
            raise RecordingFormatError(f"{path}: {flag} {wanted}: {what}; topics: {described(samples)}")
        found[kind] = [wanted]  # type: ignore[index]
    if not found["depth"]:
        raise RecordingFormatError(
            f"{path}: no topic of depth images ({_EXPECTED}); topics: {described(samples)}{_lost(samples)}"
        )
    labels = {each: _labels_of(each, depths, found["labels"], samples) for each in found["depth"]}
    pairs = [(each, other) for each in found["depth"] for other in found["color"]]
    alike = [pair for pair in pairs if color is not None or _is_one_camera(*pair, samples)]
    # Two cameras whose transform the recording has can be a rig; that is found out later.
    stated = [pair for pair in pairs if all(_camera_topic(each, samples) for each in pair)]
    apart = [pair for pair in stated if pair not in alike]
    in_order = [sorted(group, key=lambda pair: _ranks(pair[0], pair[1], samples)) for group in (alike, apart)]
    chosen: list[tuple[str, str | None]] = [pair for group in in_order for pair in group]
    if not alike:
        chosen += [(each, None) for each in sorted(found["depth"], key=_depth_rank)]
    return [
        Topics(
            each,
            other,
            labels[each],
            _camera_topic(each, samples),
            None if other is None else _camera_topic(other, samples),
        )
        for each, other in chosen
    ]


def described(samples: Mapping[str, TopicSample]) -> str:
    """Return the topics and their encodings, for a person."""
    return listed(f"{named(topic)} ({named(form_of(sample))})" for topic, sample in samples.items()) or "none"


def unread(samples: Mapping[str, TopicSample]) -> str:
    """Say which images there are that are neither depth nor color that can be read; else nothing."""
    others = {
        topic: sample
        for topic, sample in samples.items()
        if hasattr(sample.message, "data") and _kind(topic, sample, is_wanted=False) is None
    }
    return f"; not read: {described(others)}" if others else ""


def form_of(sample: TopicSample) -> str:
    """Return a topic's schema and encoding, for a person."""
    encoding = getattr(sample.message, "encoding", None) or getattr(sample.message, "format", None)
    name = sample.schema.rpartition("/")[2]
    return f"{name} {encoding}" if encoding else name


def frame_of(sample: TopicSample) -> str:
    """Return the frame of a topic's messages; transforms have none."""
    header = getattr(sample.message, "header", None)
    return "" if header is None else str(header.frame_id).lstrip("/")


def is_rectified(topic: str) -> bool:
    """Whether a topic's name says that its images are rectified."""
    return _RECTIFIED.search(topic) is not None


def says_registered(topic: str) -> bool:
    """Whether a topic's name says that its depth images are registered to color."""
    return _depth_rank(topic)[0] == 0


def camera_name(topic: str) -> tuple[str, ...]:
    """Return the parts of a topic's name that come before what its images are: whose they are."""
    parts: list[str] = []
    for part in topic.strip("/").split("/")[:-1]:
        names: list[str] = []
        before = ""
        for word in part.split("_"):
            is_number = word.isdecimal() and _NUMBERED.fullmatch(before)
            if not (is_number or _NUMBERED.fullmatch(word) or word.lower() in _WORDS):
                names.append(word)
            before = word
        if names:
            parts.append("_".join(names))
        if _OF_SENSOR.search(part):
            break
    return tuple(parts)


def _kind(topic: str, sample: TopicSample, *, is_wanted: bool) -> Kind | None:
    """Return what the images of a topic are; None where it has none that can be used.

    One that the user wants for depth is depth whatever it is called.
    """
    name = topic.lower()
    for_labels = "label" in name or "segmentation" in name
    of_depth = "depth" in name and not _INFRARED.search(name)
    # Depth as gray or colors, for people.
    of_color = not of_depth or re.search(r"rgb|colou?r", name.replace("depth_to_color", "")) is not None
    is_labels = is_depth = is_color = False
    if sample.schema == ros.COMPRESSED_IMAGE:
        text = sample.message.format.lower()
        is_labels = for_labels and "png" in text
        is_depth = images.is_compressed_depth(sample.message, topic)
        is_16_bit = text.startswith(("16uc1", "32fc1"))
        is_lossless = "png" in text or "tiff" in text
        is_depth |= (is_16_bit or (text.startswith("mono16") and of_depth)) and is_lossless
        # Programs that compress images themselves may say "png" alone.
        is_depth |= of_depth and images.is_16_bit_png(bytes(sample.message.data[:32]))
        is_stated = any(each in text for each in ("jpeg", "jpg", "png"))
        is_stated |= not text and is_image(sample.message.data[:8])
        is_color = of_color and is_stated and not is_16_bit
    elif sample.schema == ros.IMAGE:
        encoding = sample.message.encoding
        is_labels = for_labels and encoding in images.LABEL_ENCODINGS
        # An infrared image is "mono16", too, and may be "16UC1".
        is_named = is_wanted or "depth" in name or not _OTHER.search(name)
        is_depth = (encoding in ("16UC1", "32FC1") and is_named) or (encoding == "mono16" and of_depth)
        is_color = of_color and encoding in images.COLOR_ENCODINGS
    is_depth = is_depth and _DISTANCES.search(topic) is None
    return "labels" if is_labels else "depth" if is_depth else "color" if is_color else None


def _lost(samples: Mapping[str, TopicSample]) -> str:
    """Say of topics that were depth that they are no longer, and of others that they could be."""
    for topic, sample in samples.items():
        if sample.schema in (ros.IMAGE, ros.COMPRESSED_IMAGE) and _DISTANCES.search(topic):
            return f"; {named(topic)}: {ALONG_RAYS}"
    others = [topic for topic, sample in samples.items() if _kind(topic, sample, is_wanted=True) == "depth"]
    if others:
        return f"; {listed(map(named, others))}: not depth by the name, but --depth-topic reads one as such"
    lost = [
        topic
        for topic, sample in samples.items()
        if "depth" in topic.lower() and sample.schema in (ros.IMAGE, ros.COMPRESSED_IMAGE)
    ]
    how = "8 bits or JPEG do not keep depth, and other numbers are not read; record it as 16UC1"
    return f"; {listed(map(named, lost))}: {how}" if lost else ""


def _labels_of(
    depth: str, depths: list[str], labels: list[str], samples: Mapping[str, TopicSample]
) -> str | None:
    """Return the labels of the camera of a depth topic, else those that are of none of `depths`."""
    own = [label for label in labels if _are_named_alike(depth, label)]
    frames = {frame_of(samples[depth]) for depth in depths} - {frame_of(samples[depth])}
    nobodys = [
        label
        for label in labels
        if not any(_are_named_alike(other, label) for other in depths)
        and frame_of(samples[label]) not in frames
    ]
    return min(own or nobodys, key=lambda each: (-_shared(depth, each), each), default=None)


def _shared(one: str, other: str) -> int:
    """Return how many parts of the names of the cameras of two topics are the same."""
    names = zip(camera_name(one), camera_name(other), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], names))


def _is_one_camera(depth: str, color: str, samples: Mapping[str, TopicSample]) -> bool:
    return _are_named_alike(depth, color) or frame_of(samples[depth]) == frame_of(samples[color]) != ""


def _are_named_alike(one: str, other: str) -> bool:
    """Whether the name of the camera of one topic is that of the other's, or begins so."""
    return _shared(one, other) == min(len(camera_name(one)), len(camera_name(other)))


def _ranks(depth: str, color: str, samples: Mapping[str, TopicSample]) -> tuple[Any, ...]:
    one, other = camera_name(depth), camera_name(color)
    in_one_frame = frame_of(samples[depth]) == frame_of(samples[color]) != ""
    of_color = 0 if re.search(r"colou?r|rgb", color, re.IGNORECASE) else 1 + ("image" not in color.lower())
    return (
        one != other,
        _depth_rank(depth)[0],
        -_shared(depth, color),
        of_color,
        not in_one_frame,
        depth,
        color,
    )


def _depth_rank(topic: str) -> tuple[int, str]:
    name = topic.lower()
    words = (("aligned", "registered", "depth_to_rgb", "depth_to_color"), ("depth",))
    ranks = (rank for rank, each in enumerate(words) if any(word in name for word in each))
    return next(ranks, len(words)), topic


def _camera_topic(topic: str, samples: Mapping[str, TopicSample]) -> str | None:
    """Return the CameraInfo topic beside an image topic, else the one with the same frame."""
    infos = [each for each, sample in samples.items() if sample.schema == ros.CAMERA_INFO]
    parts = topic.split("/")
    for depth in range(len(parts) - 1, 1, -1):
        beside = "/".join([*parts[:depth], "camera_info"])
        if beside in infos:
            return beside
    frame = frame_of(samples[topic])
    alike = [info for info in infos if frame and frame_of(samples[info]) == frame]
    name = camera_name(topic)
    return next((info for info in alike if camera_name(info) == name), next(iter(alike), None))
