"""Each form of recording that is replayed: how the same frames are written in it, and what comes back."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
from database_bag import to_bag, to_database
from mcap.writer import CompressionType, IndexType
from recorded_scene import APART, REGISTERED, scenes, write_image, write_mcap, write_opencv, write_pairs
from recorded_scene import write_tum as write_tum_folder
from robot_bag import Bag, encoded
from ros1_bag import to_ros1

from nurbseg.drivers import Calibration, RGBDFrame

FRAMES = 12
DEPTH_FRAME, COLOR_FRAME = "cam_depth_optical", "cam_color_optical"
#: The messages of a frame, in the order of a recorder.
KINDS = ("depth_info", "color_info", "depth", "color", "labels")
#: As image_transport computes them for a depth quantization of 100 and at most 10 m.
QUANTIZATION = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0

Write = Callable[[Path, list[RGBDFrame]], Path]


@dataclass(frozen=True)
class Form:
    """A form of recording.

    Parameters
    ----------
    write : callable
        Writes frames into a folder and returns the path, or URI, to open.
    calibration : Calibration
        Of the frames.
    stamps : {"own", "microseconds", "counted"}
        Whether frames come back with their times, rounded, or at 30 Hz from 0 on.
    unit : str
        What is said of the unit of depth.
    is_checked : bool
        Whether the format has checksums, by which no changed byte goes unnoticed.
    exact_color : bool
        Whether color loses nothing.
    labels : bool
        Whether labels come back.
    cut_from : float
        Share of the file after which each of its topics has begun.
    said : str
        Part of the warnings, if there are any.
    """

    write: Write
    calibration: Calibration = APART
    stamps: str = "own"
    unit: str = "1000 per meter (ROS REP 118: 16UC1 is in millimeters)"
    is_checked: bool = False
    exact_color: bool = True
    labels: bool = True
    cut_from: float = 0.0
    said: str = ""


def rvl(image: np.ndarray) -> bytes:
    """Encode an image: runs of zeros and of others in turn, each number three bits to half a byte."""
    halves: list[int] = []

    def put(number: int) -> None:
        while True:
            halves.append(number & 7 | (8 if number > 7 else 0))
            number >>= 3
            if not number:
                return

    values = image.ravel().astype(int).tolist()
    place = before = 0
    while place < len(values):
        for zeros in (True, False):
            start = place
            while place < len(values) and (values[place] == 0) == zeros:
                place += 1
            put(place - start)
            if not zeros:
                for value in values[start:place]:
                    step = value - before
                    put(2 * step if step >= 0 else -2 * step - 1)
                    before = value
    halves += [0] * (-len(halves) % 8)
    words = [int("".join(f"{half:x}" for half in halves[n : n + 8]), 16) for n in range(0, len(halves), 8)]
    height, width = image.shape
    return struct.pack("<ii", width, height) + struct.pack(f"<{len(words)}I", *words)


def add_depth(bag: Bag, topic: str, stamp: int, depth_mm: np.ndarray, coding: str, **log: Any) -> None:
    """Add a depth image: 16UC1, 32FC1 (meters), or compressed as in "16UC1 png" or "16UC1 rvl"."""
    kind, _, codec = coding.partition(" ")
    if codec:
        # 16UC1 leaves parameters as they were in memory.
        content = rvl(depth_mm) if codec == "rvl" else encoded(".png", depth_mm)
        content, form = struct.pack("<iff", 0, 3.1e-38, 7.5) + content, f"{kind}; compressedDepth {codec}"
        bag.compressed(f"{topic}/compressedDepth", stamp, DEPTH_FRAME, content, form, **log)
        return
    meters = np.where(depth_mm > 0, depth_mm * np.float32(1e-3), np.float32(np.nan))
    bag.image(topic, stamp, DEPTH_FRAME, meters if kind == "32FC1" else depth_mm, kind, **log)


def write_messages(
    bag: Bag, order: list[tuple[str, RGBDFrame]], coding: str, now: Callable[[int], Any]
) -> None:
    """Write messages of frames; `now` gives the stamp and the log's time of a frame's time."""
    for kind, frame in order:
        stamp, log_ns = now(frame.timestamp_ns)
        camera, frame_id = frame.calibration.depth, DEPTH_FRAME
        if kind.startswith("color"):
            camera, frame_id = frame.calibration.color, COLOR_FRAME
        if kind == "depth":
            add_depth(bag, "/cam/depth/image_raw", stamp, frame.depth_mm, coding, log_ns=log_ns)
        elif kind == "color":
            bag.image("/cam/color/image_raw", stamp, frame_id, frame.color, "rgb8", log_ns)
        elif kind == "labels":
            bag.image("/cam/labels", stamp, frame_id, frame.labels, "16UC1", log_ns)
        elif kind == "tf":
            transform = frame.calibration.color_from_depth
            bag.transform("/tf_static", stamp, COLOR_FRAME, DEPTH_FRAME, transform, log_ns)
        else:
            bag.info(f"/cam/{kind.removesuffix('_info')}/camera_info", stamp, frame_id, camera, log_ns)


def by_time(frames: list[RGBDFrame]) -> list[tuple[str, RGBDFrame]]:
    return [("tf", frames[0]), *((kind, frame) for frame in frames for kind in KINDS)]


def by_topic(frames: list[RGBDFrame]) -> list[tuple[str, RGBDFrame]]:
    return [("tf", frames[0]), *((kind, frame) for kind in KINDS for frame in frames)]


def robot(
    folder: Path,
    frames: list[RGBDFrame],
    *,
    order: Callable[[list[RGBDFrame]], list[tuple[str, RGBDFrame]]] = by_time,
    coding: str = "16UC1",
    now: Callable[[int], Any] = lambda ns: (ns, ns),
    **options: Any,
) -> Path:
    """Write an MCAP file as a robot's recorder does."""
    bag = Bag(folder / "a.mcap", **options)
    write_messages(bag, order(frames), coding, now)
    return bag.close()


def split(folder: Path, frames: list[RGBDFrame], *, listed: str = "", count: int = 12) -> Path:
    """Write a bag of several files; CameraInfo and the transform are published once."""
    parts = np.array_split(np.arange(len(frames)), count)
    for number, part in enumerate(parts):
        order = (
            [("tf", frames[0]), ("depth_info", frames[0]), ("color_info", frames[0])] if number == 0 else []
        )
        order += [(kind, frames[index]) for index in part for kind in KINDS[2:]]
        bag = Bag(folder / "ride" / f"ride_{number}.mcap")
        write_messages(bag, order, "16UC1", lambda ns: (ns, ns))
        bag.close()
    if listed:
        list_parts(folder / "ride", [f"{listed}ride_{number}.mcap" for number in range(count)])
    return folder / "ride"


def list_parts(folder: Path, names: list[str]) -> None:
    """Write the metadata of a bag of these files."""
    lines = "".join(f"    - {name}\n" for name in names)
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}")


def database(folder: Path, frames: list[RGBDFrame], **how: Any) -> Path:
    return to_database(robot(folder, frames), folder / "a b?#%.db3", **how)


def split_database(folder: Path, frames: list[RGBDFrame]) -> Path:
    """Write a database of two files, which are named against their order."""
    whole = database(folder, frames)
    (folder / "bag").mkdir()
    for name, comparison in (("late.db3", "<"), ("early.db3", ">=")):
        shutil.copy(whole, folder / "bag" / name)
        with sqlite3.connect(folder / "bag" / name) as base:
            middle = frames[len(frames) // 2].timestamp_ns
            base.execute(f"DELETE FROM messages WHERE NOT timestamp {comparison} ?", (middle,))
        base.close()
    list_parts(folder / "bag", ["late.db3", "early.db3"])
    return folder / "bag"


def ros1(folder: Path, frames: list[RGBDFrame], compression: str | None = None) -> Path:
    return to_ros1(robot(folder, frames), folder / "a.bag", compression)


def rosbags(folder: Path, frames: list[RGBDFrame], **how: Any) -> Path:
    return to_bag(robot(folder, frames), folder / "bag", **how)


def patterns(folder: Path, frames: list[RGBDFrame]) -> Path:
    write_pairs(folder, frames)
    return f"images:?{urlencode({kind: folder / f'*_{kind}.png' for kind in ('color', 'depth')})}"  # type: ignore[return-value]


def arrays(folder: Path, frames: list[RGBDFrame]) -> Path:
    """Write a folder of arrays: color, and depth in meters."""
    for frame in frames:
        for kind, image in (("color", frame.color), ("depth", (frame.depth_mm / 1000).astype(np.float32))):
            (folder / kind).mkdir(exist_ok=True)
            np.save(folder / kind / f"{frame.index}.npy", image)
        write_image(folder / "label" / f"{frame.index}.png", frame.labels)
    write_opencv(folder / "calibration.yml", frames[0].calibration)
    return folder


def numbered_scenes(folder: Path, frames: list[RGBDFrame]) -> Path:
    """Write a folder for each frame, with the calibration in it."""
    for frame in frames:
        scene = folder / f"scene{frame.index + 1}"
        for kind, image in (("color", frame.color), ("depth", frame.depth_mm), ("labels", frame.labels)):
            write_image(scene / f"{kind}.png", image)
        write_opencv(scene / "calibration.xml", frame.calibration)
    return folder


def ours(folder: Path, frames: list[RGBDFrame], color: Any) -> Path:
    return write_mcap(folder / "a.mcap", frames, color)


def _mcap(**how: Any) -> Form:
    return Form(partial(robot, **how), is_checked=how.get("use_chunking", True))


_DEFAULT = "1000 per meter (the default for whole numbers)"
FORMS = {
    "ours": Form(partial(ours, color="png"), REGISTERED, is_checked=True),
    "ours-raw": Form(partial(ours, color="raw"), is_checked=True),
    "ours-jpeg": Form(partial(ours, color="jpeg95"), is_checked=True, exact_color=False),
    "mcap-zstd": _mcap(),
    "mcap-lz4": _mcap(compression=CompressionType.LZ4),
    "mcap-none": _mcap(compression=CompressionType.NONE),
    "mcap-no-index": _mcap(index_types=IndexType.NONE),
    "mcap-unchunked": _mcap(use_chunking=False),
    "mcap-by-topic": Form(partial(robot, order=by_topic), is_checked=True, cut_from=0.8),
    "mcap-no-log": _mcap(now=lambda ns: (ns, 0)),
    "mcap-no-stamps": Form(
        partial(robot, now=lambda ns: (0, ns)), is_checked=True, said="the stamps of depth are 0"
    ),
    "mcap-float": Form(
        partial(robot, coding="32FC1"), unit="1 per meter (ROS REP 118: 32FC1 is in meters)", is_checked=True
    ),
    "mcap-depth-png": _mcap(coding="16UC1 png"),
    "mcap-big-endian": _mcap(little_endian=False),
    "mcap-depth-rvl": _mcap(coding="16UC1 rvl"),
    "split": Form(split),
    "split-listed": Form(partial(split, listed="ride/", count=3)),
    "rosbag2-mcap-packed": Form(partial(rosbags, mcap=True, packed=True)),
    "rosbag2-db3": Form(rosbags, cut_from=0.8),
    "rosbag2-db3-packed": Form(partial(rosbags, packed=True), cut_from=0.8),
    "db3": Form(database),
    "db3-split": Form(split_database),
    "bag": Form(ros1),
    "bag-bz2": Form(partial(ros1, compression="BZ2")),
    "bag-lz4": Form(partial(ros1, compression="LZ4")),
    "tum": Form(
        write_tum_folder, stamps="microseconds", unit="5000 per meter (TUM RGB-D's own)", labels=False
    ),
    "pairs": Form(write_pairs, REGISTERED, stamps="counted", unit=_DEFAULT),
    "patterns": Form(patterns, stamps="counted", unit=_DEFAULT, labels=False),
    "arrays": Form(arrays, stamps="counted", unit="1 per meter (the default for floating point)"),
    "scenes": Form(numbered_scenes, stamps="counted", unit=_DEFAULT),
}


def frames_of(form: Form, count: int = FRAMES) -> list[RGBDFrame]:
    return scenes(count, form.calibration)
