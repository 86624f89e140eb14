"""Finds which topics of a recording are the depth images, the color images, their cameras and labels."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product, takewhile
from pathlib import Path
from typing import Any

from nurbseg.common.errors import RecordingFormatError, listed, named
from nurbseg.drivers.calibration.foreign import is_image
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.decoding import images
from nurbseg.drivers.mcap.pairing import Kind

#: What a topic measures: the last of these words counts.
_MEASURED = re.compile(r"depth(?:_to_\w+)?|colou?r|rgb|infra|(?<![a-z])ir(?![a-z])", re.IGNORECASE)
#: Ends the name of the camera. RealSense's SDK numbers the sensors of a device.
_END_OF_CAMERA = re.compile(rf"sensor_\d|aligned_|registered_|{_MEASURED.pattern}", re.IGNORECASE)
#: Rectified by ROS's own words for it; RealSense's "rect_raw" is named so whatever its distortion is.
_RECTIFIED = re.compile(r"(^|[_/])rect(ified)?(?!_raw)(_|/|$)", re.IGNORECASE)
#: The names of distances along rays in Isaac Sim, ifm3d and AirSim.
_DISTANCES = re.compile(r"distance_to_camera|radial_distance|depth_?perspective", re.IGNORECASE)
_ALONG_RAYS = (
    "by its name the distance along each pixel's ray, not depth along the camera's axis; divide it by "
    "sqrt(((column - cx) / fx)^2 + ((row - cy) / fy)^2 + 1), and save it under another name"
)
_EXPECTED: dict[Kind, str] = {
    "depth": "Image 16UC1 or 32FC1, or CompressedImage compressedDepth",
    "color": "Image rgb8, bgr8 or mono8, or CompressedImage jpeg or png",
}


@dataclass(frozen=True, slots=True, eq=False)
class TopicSample:
    """A topic, the name of its schema and its first message, decoded; None if that is of transforms."""

    topic: str
    schema: str
    message: Any

    @property
    def encoding(self) -> str:
        """The encoding of images, "" for other messages."""
        return str(getattr(self.message, "encoding", "") or getattr(self.message, "format", ""))

    @property
    def frame(self) -> str:
        """The frame of the messages, "" for transforms."""
        header = getattr(self.message, "header", None)
        return "" if header is None else str(header.frame_id).lstrip("/")

    @property
    def camera(self) -> tuple[str, ...]:
        """The camera's name: the parts of the topic's that come before what it measures."""
        folder = self.topic.rpartition("/")[0]
        parts = (part.strip("_") for part in _END_OF_CAMERA.split(folder, maxsplit=1)[0].split("/"))
        return tuple(part for part in parts if part)

    @property
    def is_rectified(self) -> bool:
        """Whether the topic is named as rectified images."""
        return _RECTIFIED.search(self.topic) is not None

    def kind(self, *, is_wanted: bool = False) -> Kind | None:
        """Return what the images of the topic are; None if they are of no use.

        The name decides what the encoding leaves open: infrared images may be 16UC1, too, and depth may be
        shown in gray or colors. Where the user names the topic, the encoding decides alone.
        """
        text, name = self.encoding, self.topic.lower()
        if self.schema == ros.IMAGE:
            is_depth, is_color = text in images.DEPTH_ENCODINGS, text in images.COLOR_ENCODINGS
            is_labels = text in images.LABEL_ENCODINGS
        elif self.schema == ros.COMPRESSED_IMAGE:
            text, head = text.lower(), bytes(self.message.data[:32])
            # Programs that compress images themselves may say "png" alone, or nothing.
            is_labels, is_lossless = "png" in text, "png" in text or "tiff" in text
            is_16_bit = text.startswith(("16uc1", "32fc1", "mono16")) or images.is_16_bit_png(head)
            is_depth = images.is_compressed_depth(self.message, self.topic) or (is_16_bit and is_lossless)
            is_color = any(word in text for word in ("jpeg", "jpg", "png")) or (not text and is_image(head))
        else:
            return None
        if is_labels and ("label" in name or "segmentation" in name):
            return "labels"
        is_named_depth = "".join(_MEASURED.findall(name)[-1:]).startswith("depth")
        if is_depth and not _DISTANCES.search(name):
            return "depth" if is_named_depth or is_wanted else None
        return "color" if is_color and (is_wanted or not is_named_depth) else None

    def why_no_depth(self) -> str:
        """Return why images that might be depth are none, and what to do; "" if nothing speaks for depth."""
        if self.schema not in (ros.IMAGE, ros.COMPRESSED_IMAGE):
            return ""
        if _DISTANCES.search(self.topic):
            return _ALONG_RAYS
        if self.kind(is_wanted=True) == "depth":
            return "not depth by the name, but --depth-topic reads it as such"
        lost = "8 bits or JPEG do not keep depth, and other numbers are not read; record it as 16UC1"
        return lost if "depth" in self.topic.lower() else ""


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
    """Return the cameras that there are, the best first, by the encodings and names of their first messages.

    Depth never goes with the color of another camera: the two share the camera's name or the frame, or each
    has a CameraInfo, between which a transform is then needed. Depth in the frame of its color comes first.
    Without color of its camera depth is by itself. `depth` and `color` are topics that the user names. Raises
    RecordingFormatError if there is no depth, or no such topic; says which topics there are.
    """
    found: dict[Kind | None, list[TopicSample]] = {"depth": [], "color": [], "labels": [], None: []}
    for topic, sample in samples.items():
        found[sample.kind(is_wanted=topic in (depth, color))].append(sample)
    every = found["depth"]
    wanted: tuple[tuple[Kind, str | None], ...] = (("depth", depth), ("color", color))
    for kind, name in wanted:
        if name is None:
            continue
        found[kind] = [sample for sample in found[kind] if sample.topic == name]
        if not found[kind]:
            why = samples[name].why_no_depth() if name in samples and kind == "depth" else ""
            what = why or f"not {kind} images ({_EXPECTED[kind]})" if name in samples else "no such topic"
            raise RecordingFormatError(f"{path}: --{kind}-topic {name}: {what}; topics: {described(samples)}")
    if not every:
        said = (f"; {named(topic)}: {why}" for topic, each in samples.items() if (why := each.why_no_depth()))
        expected = f"no topic of depth images ({_EXPECTED['depth']})"
        raise RecordingFormatError(f"{path}: {expected}; topics: {described(samples)}{''.join(said)}")
    infos = {each: _camera_info(each, samples) for each in (*found["depth"], *found["color"])}
    pairs = sorted(product(found["depth"], found["color"]), key=lambda pair: _rank(*pair))
    alike = [pair for pair in pairs if color is not None or any(_likeness(*pair)[:3])]
    # Two cameras whose transform the recording has can be a rig; that is found out later.
    apart = [pair for pair in pairs if pair not in alike and all(infos[each] for each in pair)]
    alone = [] if alike else [(each, None) for each in sorted(found["depth"], key=lambda each: each.topic)]
    # Labels are those of the depth topic that they are most like.
    nearest = {each: max(_likeness(one, each) for one in every) for each in found["labels"]}
    labels: dict[TopicSample, str | None] = {}
    for one in found["depth"]:
        own = {each.topic: best for each, best in nearest.items() if _likeness(one, each) == best}
        labels[one] = min(own, key=lambda topic: (-own[topic][1], -own[topic][3], topic), default=None)
    return [
        Topics(one.topic, two.topic if two else None, labels[one], infos[one], infos[two] if two else None)
        for one, two in (*alike, *apart, *alone)
    ]


def described(samples: Mapping[str, TopicSample]) -> str:
    """Return the topics and their encodings, for a person."""
    forms = {topic: f"{each.schema.rpartition('/')[2]} {each.encoding}" for topic, each in samples.items()}
    return listed(f"{named(topic)} ({named(form.rstrip())})" for topic, form in forms.items()) or "none"


def unread(samples: Mapping[str, TopicSample]) -> str:
    """Return which images are neither depth nor color that can be read, "" if there are none."""
    of_images = (item for item in samples.items() if hasattr(item[1].message, "data"))
    others = {topic: sample for topic, sample in of_images if sample.kind() is None}
    return f"; not read: {described(others)}" if others else ""


def _likeness(one: TopicSample, other: TopicSample) -> tuple[bool, bool, bool, int]:
    """Return whether two cameras share the name, the shorter name, the frame; how many parts of the name."""
    parts = zip(one.camera, other.camera, strict=False)
    shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], parts))
    lengths = len(one.camera), len(other.camera)
    return shared == max(lengths), shared == min(lengths), one.frame == other.frame != "", shared


def _rank(depth: TopicSample, color: TopicSample) -> tuple[Any, ...]:
    is_same, _, is_in_one_frame, shared = _likeness(depth, color)
    is_named_color = re.search("colou?r|rgb", color.topic, re.IGNORECASE) is not None
    return -is_same, -is_named_color, -is_in_one_frame, -shared, depth.topic, color.topic


def _camera_info(image: TopicSample, samples: Mapping[str, TopicSample]) -> str | None:
    """Return the CameraInfo topic beside an image topic, else the first with the same frame."""
    infos = {topic: sample for topic, sample in samples.items() if sample.schema == ros.CAMERA_INFO}
    folders = image.topic.split("/")[:-1]
    beside = ["/".join([*folders[:depth], "camera_info"]) for depth in range(len(folders), 1, -1)]
    alike = [topic for topic, info in infos.items() if info.frame == image.frame != ""]
    return next((topic for topic in beside + alike if topic in infos), None)
