"""Small files that somebody made to exhaust or crash a reader: each gets a typed error, for little memory."""

import itertools
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import pytest
import zstandard
from bounded_child import Reading, read_bounded
from hostile_files import GIB, black_png, mcap_chunk, mcap_file, mcap_record, png_chunk, tiff, zeros
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from recorded_scene import scenes, write_mcap, write_pairs
from robot_bag import TYPES

from nurbseg.common.limits import CHUNK_BYTES_MAX, PIXELS_MAX
from nurbseg.drivers import FrameFormatError, RecordingFormatError, open_source
from nurbseg.drivers.datasets.images import decode_color, decode_stored

#: What one hostile file may take: one decoded image of the largest size, and its copies.
TAKEN_MAX = GIB // 2


def refused(path: Path, text: str) -> Reading:
    reading = read_bounded(path)
    assert reading.frames == 0
    assert any(text in error for error in reading.errors), reading.errors
    assert all(len(error) < 1000 for error in reading.errors)
    assert reading.taken_bytes < TAKEN_MAX, f"{reading.taken_bytes / 2**20:.0f} MB"
    return reading


def compressed(content: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(content)


def in_chunk(content: bytes) -> bytes:
    return mcap_chunk(compressed(content), len(content), "zstd")


def written(record: Schema | Channel) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def bomb(compression: str, declared: int) -> list[bytes]:
    return [mcap_chunk(zeros(2 * GIB, compression), declared, compression)]


def stated() -> list[bytes]:
    """2 GiB of zeros, of which the frame's head says so."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=2 * GIB)
    frame = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1 << 11)) + packer.flush()
    return [mcap_chunk(frame, 1000, "zstd")]


def claimed(declared: int) -> list[bytes]:
    """A zstd frame of one block whose header says 8 GiB."""
    frame = b"\x28\xb5\x2f\xfd\xc0\x60" + (8 * GIB).to_bytes(8, "little") + compressed(bytes(1 << 17))[-8:]
    return [mcap_chunk(frame, declared, "zstd")]


def repeated(pattern: bytes) -> list[bytes]:
    """Millions of records in 1 GiB of chunks."""
    return [in_chunk(pattern * ((CHUNK_BYTES_MAX - 64) // len(pattern)))] * 8


def many_topics(kind: str, body: bytes) -> list[bytes]:
    """The first message of each of 16 topics, 60 MB each."""
    text, _ = TYPES.generate_msgdef(kind, ros_version=2)
    records, chunks = [written(Schema(id=1, name=kind, encoding="ros2msg", data=text.encode()))], []
    for number in range(1, 17):
        channel = Channel(id=number, topic=f"/t{number}", message_encoding="cdr", schema_id=1, metadata={})
        records.append(written(channel))
        message = mcap_record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, 0, 0) + b"\0\1\0\0" + body)
        chunks.append(in_chunk(message))
    return records + chunks


def large_image() -> bytes:
    body = (struct.pack("<iI", 100, 0) + struct.pack("<I2s", 2, b"f")).ljust(16, b"\0")
    body += struct.pack("<III6s", 4, 4, 6, b"mono8") + b"\0\0"
    return body + struct.pack("<II", 4, 60 << 20) + bytes(60 << 20)


def many_transforms() -> bytes:
    names = struct.pack("<iI", 100, 0) + struct.pack("<I4sI4s", 4, b"abc", 4, b"def")
    pose = struct.pack("<7d", *[0.0] * 6, 1.0)
    return struct.pack("<I", 60_000) + names + bytes(4) + pose + (names + pose) * 59_999


def large_schemas() -> list[bytes]:
    schemas = [Schema(id=n, name="a", encoding="ros2msg", data=bytes(15 << 20)) for n in range(1, 7)]
    return [in_chunk(written(schema)) for schema in schemas]


#: Records of files that would take gigabytes.
BOMBS: dict[str, Callable[[], list[bytes]]] = {
    **{
        f"{compression} {declared}": partial(bomb, compression, size)
        for compression in ("zstd", "lz4")
        for declared, size in (("small", 1000), ("within", CHUNK_BYTES_MAX), ("huge", 2 * GIB))
    },
    "stated": stated,
    "claimed": lambda: claimed(8 * GIB - 1),
    "claimed small": lambda: claimed(1 << 17),
    "records of nothing": lambda: repeated(b"\0"),
    "messages of nothing": lambda: repeated(mcap_record(Opcode.MESSAGE, bytes(23))),
    "unknown records": lambda: repeated(mcap_record(200, b"")),
    "images": lambda: many_topics("sensor_msgs/msg/Image", large_image()),
    "transforms": lambda: many_topics("tf2_msgs/msg/TFMessage", many_transforms()),
    "schemas": large_schemas,
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_would_take_gigabytes_is_refused(tmp_path: Path, name: str) -> None:
    path = mcap_file(tmp_path / "bomb.mcap", BOMBS[name]())
    assert path.stat().st_size < 20e6
    refused(path, "bomb.mcap: ")


@pytest.mark.parametrize("kind", [Opcode.SCHEMA, Opcode.CHUNK, Opcode.MESSAGE, Opcode.ATTACHMENT])
def test_a_record_of_gigabytes_is_not_read(tmp_path: Path, kind: int) -> None:
    path = tmp_path / "long.mcap"
    head = b"\x89MCAP0\r\n" + mcap_record(Opcode.HEADER, bytes(8))
    path.write_bytes(head + bytes([kind]) + (32 * GIB).to_bytes(8, "little"))
    os.truncate(path, len(head) + 9 + 32 * GIB)
    refused(path, "long.mcap: ")


def unpaired(depth: int) -> bytes:
    """Depth images of 100 MB without color."""
    chunks = []
    for second in range(1000, 1008):
        head = struct.pack("<HIQQ", depth, 0, second * 10**9, 0) + b"\0\1\0\0" + struct.pack("<iI", second, 0)
        chunks.append(in_chunk(mcap_record(Opcode.MESSAGE, head + bytes(100 << 20))))
    return b"".join(chunks)


def test_the_frames_before_images_without_partners_are_read(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(3))
    content = path.read_bytes()
    with path.open("rb") as stream:
        channels = [record for record in StreamReader(stream).records if isinstance(record, Channel)]
    (depth,) = {channel.id for channel in channels if channel.topic == "/camera/depth/image_raw"}
    end = content.rindex(mcap_record(Opcode.DATA_END, bytes(4))[:9])
    # Where there is an index, nothing else is read.
    path.write_bytes(content[:end] + unpaired(depth))
    reading = read_bounded(path)
    assert (reading.frames, reading.errors) == (3, [])
    assert reading.taken_bytes < TAKEN_MAX, f"{reading.taken_bytes / 2**20:.0f} MB"


def test_metadata_that_fill_the_memory_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "many.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number in range(6):
            writer.add_metadata(str(number), {"a": "b" * (15 << 20)})
        writer.finish()
    refused(path, "many.mcap: ")


def test_a_file_that_was_made_longer_with_zeros_ends_where_it_was_written(tmp_path: Path, caplog) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(2))
    content = path.read_bytes()
    path.write_bytes(content[: content.rindex(mcap_record(Opcode.DATA_END, bytes(4))[:9])])
    os.truncate(path, 64 * GIB)
    with open_source(path) as source:
        assert len(list(source)) == 2
    assert "is cut off" in caplog.text


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (black_png(60_000, 50_000), "expected 16777216 pixels at most"),
        (tiff(60_000, 50_000), "expected 16777216 pixels at most"),
        (tiff(12_000, 5_000), "expected 16777216 pixels at most, got 12000 x 5000"),
        (tiff(4000, 16, strip_rows=1 << 22), "cut off, damaged or of a kind that is not read"),
        (tiff(64, 48, channels=1000), "of a kind that is not read"),
        (b"P5 99999 99999 65535 ", "expected 16777216 pixels at most"),
        (b"P5 " + b"9" * 5000 + b" 9 255 ", "Token too long in file header"),
        (
            b"\xff\xd8\xff\xc0\x00\x0b\x08" + b"\xff" * 4 + b"\x01\x01\x11\x00\xff\xd9",
            "expected 16777216 pixels at most",
        ),
        (b"\xff\xd8\xff\xe0\x00", "cut off, damaged or of a kind"),
        (b"BM" + bytes(12) + b"\x28\0\0\0" + b"\xff\xff\0\0" * 2 + bytes(40), "Unsupported BMP"),
        (b"RIFF\0\0\0\0WEBPVP8 ", "not an image that can be decoded"),
    ],
    ids=["png", "tiff", "large tiff", "strip", "channels", "pgm", "digits", "jpeg", "short", "bmp", "webp"],
)
def test_an_image_that_would_be_too_large_is_refused_by_its_header(tmp_path, content, text):
    path = write_pairs(tmp_path, scenes(1))
    (path / "shot0_depth.png").write_bytes(content)
    refused(path, text)


def test_an_image_of_the_largest_size_is_decoded() -> None:
    side = int(PIXELS_MAX**0.5)
    assert decode_stored(black_png(side, side), "a").shape == (side, side)


def test_a_png_whose_texts_become_gigabytes_is_refused(tmp_path: Path) -> None:
    text = png_chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(7 << 20), 9))
    path = write_pairs(tmp_path, scenes(1))
    encoded = cv2.imencode(".png", scenes(1)[0].depth_mm)[1].tobytes()
    (path / "shot0_depth.png").write_bytes(encoded[:33] + text * 400 + encoded[33:])
    refused(path, "Decompressed data too large")


def test_a_progressive_jpeg_of_thousands_of_scans_is_refused() -> None:
    parameters = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    content = cv2.imencode(".jpg", scenes(1)[0].color, parameters)[1].tobytes()
    decode_color(content, "a")
    last = content.rindex(b"\xff\xda")
    with pytest.raises(FrameFormatError, match="more than 100 scans"):
        decode_color(content[:last] + content[last:-2] * 200 + content[-2:], "a")


@pytest.mark.parametrize("special", ["fifo", "zero", "folder", "nothing"])
def test_an_image_that_is_no_regular_file_costs_its_frame(tmp_path: Path, special: str) -> None:
    path = write_pairs(tmp_path, scenes(2))
    image = path / "shot0_color.png"
    image.unlink()
    if special == "fifo":
        os.mkfifo(image)
    elif special == "zero":
        image.symlink_to("/dev/zero")
    elif special == "folder":
        image.mkdir()
    else:
        image.symlink_to("nowhere")
    reading = read_bounded(path)
    assert reading.frames == 1
    if special != "folder":
        assert "shot0_color.png: the image cannot be read" in reading.errors[0]


@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "a.bag", "camera.toml"])
def test_a_pipe_is_no_recording_and_no_calibration(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    refused(tmp_path / name, "cannot be read (not a regular file)")


CALIBRATIONS = {
    "brackets.yml": "[" * 100_000,
    "nested.yml": "%YAML:1.0\n---\nM1: " + "[" * 100_000,
    "mappings.yaml": "".join(f"{' ' * n}a:\n" for n in range(600)),
    "aliases.yml": "a: &a [x,x,x,x,x,x,x,x,x]\n"
    + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in itertools.pairwise("abcdefghij"))
    + "camera_matrix: *j\n",
    "overlap.yml": "%YAML:1.0\n---\nM1: !!opencv-matrix\n  rows: 300000\n  cols: 300\n  dt: d\n"
    "  data: [1., 2.]\n",
    "repeated.yaml": 'camera_matrix: {rows: "a", cols: 4000000000, data: [1]}\n',
    "digits.yaml": f"image_width: {'9' * 5000}\nimage_height: 5\nk: [1,0,0,0,1,0,0,0,1]\n",
    "date.yaml": "k: [2001-99-99, 0,0,0,1,0,0,0,1]\nwidth: 1\nheight: 1\n",
    "tag.yaml": "k: !!python/object/apply:os.system ['true']\n",
    "long.yaml": "k: [" + "1," * 200_000 + "1]",
    "nested.xml": "<?xml version='1.0'?><opencv_storage>" + "<a>" * 100_000,
    "nested_whole.xml": f"<opencv_storage>{'<a>' * 30_000}{'</a>' * 30_000}</opencv_storage>",
    "overlap.xml": "<?xml version='1.0'?><opencv_storage><M1 type_id='opencv-matrix'><rows>300000</rows>"
    "<cols>300</cols><dt>d</dt><data>1. 2.</data></M1></opencv_storage>",
    "entities.xml": "<!DOCTYPE a [<!ENTITY a 'aaaaaaaaaa'>]><rgb>&a;</rgb>",
    "digits.txt": f"{'9' * 5000} 0 1\n0 1 1\n0 0 1\n",
    "nested.toml": "registered = " + "[" * 50_000,
    "digits.toml": f"depth_scale = {'9' * 5000}",
    "registered.toml": f"registered = 0x{'f' * 4000}",
    "dotted.toml": ".".join(["a"] * 120_000) + " = 1",
    "wide.toml": "registered = true\n[color]\nwidth = 99999999999\nheight = 1\nfx=1\nfy=1\ncx=1\ncy=1\n",
    "large.toml": "# " + "x" * 10_000_000,
    "words.txt": "1 2 " + "x" * 200_000,
}  # fmt: skip


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_a_hostile_calibration_gets_a_short_typed_error(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(CALIBRATIONS[name])
    reading = read_bounded(path)
    (error,) = reading.errors
    assert error.startswith(f"CalibrationError: {path}: ")
    assert len(error) - len(str(path)) < 400
    assert reading.taken_bytes < 100 << 20


def test_a_replayed_folder_that_is_deleted_ends_the_replay_and_says_so(tmp_path: Path) -> None:
    folder = write_pairs(tmp_path / "pairs", scenes(4))
    with open_source(folder) as source:
        source.read()
        shutil.rmtree(folder)
        with pytest.raises(
            RecordingFormatError, match=r"pairs: the recording is gone.* after 1 of 4 frames"
        ) as found:
            source.read()
    assert not isinstance(found.value, FrameFormatError)
