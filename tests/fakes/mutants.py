"""Files of every form that is read, and changes to them: what each reader is fuzzed with."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from mcap.records import Channel, DataEnd, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from recorded_forms import database, ros1
from recorded_scene import (
    APART,
    scene,
    scenes,
    write_mcap,
    write_opencv,
    write_tum,
)

from nurbseg.app.command.config_file import ConfigError, format_config, read_config
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.drivers import DriverError, EndOfRecordingError, FrameFormatError, open_source
from nurbseg.drivers.calibration.file import read_camera_file, write_calibration
from nurbseg.drivers.datasets.images import decode_color, decode_labels, decode_stored

#: Frames read of one mutant at most.
_FRAMES_MAX = 20
_WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e999", b"1e-320", b"4294967296", b"9" * 400, b"0x" + b"f" * 99,
    b"[" * 300, b"{" * 300, b"<a>" * 300, b"\0", b"\xff", b"'", b'"', b"&a *a",
    b"!!python/object", b"\n", b"=", b": ",
)  # fmt: skip
_CAMERA_INFO = b"""image_width: 64
image_height: 48
distortion_model: plumb_bob
camera_matrix:
  rows: 3
  cols: 3
  data: [52.5, 0.0, 31.5, 0.0, 52.5, 23.5, 0.0, 0.0, 1.0]
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.07, -0.03, -0.01, 0.0, -0.14]
"""
_NUMBERS = [0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF]


@dataclass(frozen=True)
class Form:
    """One form of file: a whole one, and what reads the file of a path and raises typed errors only."""

    name: str
    content: bytes
    read: Callable[[Path], None]


def forms(folder: Path) -> dict[str, Form]:
    """Return a small file of each form; `folder` is for what they are made with."""
    frame = scene(0)
    found: dict[str, tuple[bytes, Callable[[Path], None]]] = {}
    for color in ("png", "raw", "jpeg95"):
        path = write_mcap(folder / f"{color}.mcap", scenes(3, APART), color)  # type: ignore[arg-type]
        found[f"{color}.mcap"] = path.read_bytes(), _replay
    found["plain.mcap"] = _plain_mcap(folder / "raw.mcap", folder / "plain.mcap").read_bytes(), _replay
    for path in (database(folder, scenes(3, APART)), ros1(folder, scenes(3, APART), "LZ4")):
        found[f"a{path.suffix}"] = path.read_bytes(), _replay
    found["depth.txt"] = (write_tum(folder / "tum", scenes(3)) / "depth.txt").read_bytes(), _replay_list
    bgr = np.ascontiguousarray(frame.color[..., ::-1])
    for extension, image in [
        ("png", frame.depth_mm), ("tiff", frame.depth_mm), ("pgm", frame.depth_mm), ("jpg", bgr),
        ("ppm", bgr), ("bmp", bgr), ("tif", frame.depth_mm.astype(np.float32)),
    ]:  # fmt: skip
        found[f"image.{extension}"] = cv2.imencode(f".{extension}", image)[1].tobytes(), _decode
    write_calibration(folder / "a.toml", APART)
    for name in ("a.xml", "a.yml"):
        write_opencv(folder / name, APART)
    for extension in ("toml", "xml", "yml"):
        found[f"stereo.{extension}"] = (folder / f"a.{extension}").read_bytes(), _calibrate
    found["ros.yaml"] = _CAMERA_INFO, _calibrate
    found["matrix.txt"] = b"52.5 0 31.5\n0 52.6 23.5\n0 0 1\n", _calibrate
    found["config.toml"] = format_config(AppConfig()).encode(), _configure
    return {name: Form(name, content, read) for name, (content, read) in found.items()}


def mutant(content: bytes, rng: random.Random) -> bytes:
    """Return the content with one to eight changes."""
    changed = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 3, 8])):
        near = rng.choice([64, 1000, 1 << 30])
        place = rng.randrange(min(near, len(changed)) or 1)
        kind = rng.randrange(7)
        if kind == 0 and changed:
            changed[min(place, len(changed) - 1)] = rng.randrange(256)
        elif kind == 1:
            size = rng.choice([1, 2, 4, 8])
            number = rng.choice(_NUMBERS) & ((1 << 8 * size) - 1)
            changed[place : place + size] = number.to_bytes(size, rng.choice(["little", "big"]))  # type: ignore[arg-type]
        elif kind == 2:
            del changed[place : place + rng.choice([1, 4, 50, 1 << 30])]
        elif kind == 3:
            changed[place:place] = changed[place : place + rng.choice([4, 40, 400])] * rng.choice([1, 3, 30])
        elif kind == 4:
            changed[place:place] = rng.choice(_WORDS)
        else:
            # A number or word of a text, wherever it is.
            found = list(re.finditer(rb"[-+.\w]+", changed[:20_000]))
            if found:
                start, end = rng.choice(found).span()
                changed[start:end] = rng.choice(_WORDS)
    return bytes(changed)


def read_mutant(form: Form, content: bytes, folder: Path) -> bool:
    """Read a mutant; return whether it was refused. Any error but a typed one comes through."""
    path = folder / form.name
    path.write_bytes(content)
    try:
        form.read(path)
    except (DriverError, ConfigError) as err:
        if len(str(err)) > 2000:
            raise AssertionError(f"a message of {len(str(err))} characters") from err
        return True
    return False


def _plain_mcap(path: Path, other: Path) -> Path:
    """Copy a recording without compression and checksums, which would find most changes first."""
    with path.open("rb") as stream, other.open("wb") as out:
        writer = Writer(out, compression=CompressionType.NONE, enable_crcs=False)
        writer.start(profile="ros2", library="test")
        for record in StreamReader(stream).records:
            if isinstance(record, Schema):
                writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                writer.register_channel(record.topic, record.message_encoding, record.schema_id)
            elif isinstance(record, Message):
                writer.add_message(record.channel_id, record.log_time, record.data, record.publish_time)
            elif isinstance(record, DataEnd):
                break
        writer.finish()
    return other


def _replay(path: Path) -> None:
    refused: FrameFormatError | None = None
    with open_source(path) as source:
        for _ in range(_FRAMES_MAX):
            try:
                source.read()
            except FrameFormatError as err:
                refused = err
            except EndOfRecordingError:
                break
    if refused is not None:
        raise refused


def _replay_list(path: Path) -> None:
    """Replay a TUM folder whose list of depth images is this one."""
    folder = path.parent / "list"
    if not folder.exists():
        write_tum(folder, scenes(3))
    shutil.copyfile(path, folder / "depth.txt")
    _replay(folder)


def _decode(path: Path) -> None:
    content = path.read_bytes()
    refused: FrameFormatError | None = None
    for decode in (decode_color, decode_labels, decode_stored):
        try:
            decode(content, str(path))
        except FrameFormatError as err:
            refused = err
    if refused is not None:
        raise refused


def _calibrate(path: Path) -> None:
    read_camera_file(path).calibration(depth_size=(64, 48), color_size=(80, 60)).depth.rays()


def _configure(path: Path) -> None:
    read_config(path)


__all__ = ["Form", "forms", "mutant", "read_mutant"]
