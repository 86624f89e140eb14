"""Small files that somebody made to exhaust or crash a reader: each gets a typed error, for little memory."""

import itertools
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import lz4.frame
import pytest
import zstandard
from all_frames import frames_and_errors
from bounded_child import Reading, read_bounded
from hostile_files import GIB, black_png, mcap_chunk, mcap_file, mcap_record, png_chunk, tiff, zeros
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from recorded_scene import scenes, write_mcap, write_pairs, write_tum

from nurbseg.common.limits import CHUNK_BYTES_MAX, PIXELS_MAX
from nurbseg.drivers import FrameFormatError, RecordingFormatError, open_source
from nurbseg.drivers.datasets.images import decode_color, decode_stored
from nurbseg.drivers.mcap import ros_messages as ros

#: What one hostile file may take: one decoded image of the largest size, and its copies.
TAKEN_MAX = GIB // 2


def refused(path: Path, text: str) -> Reading:
    reading = read_bounded(path)
    assert reading.frames == 0
    assert any(text in error for error in reading.errors), reading.errors
    assert all(len(error) < 1000 for error in reading.errors)
    assert reading.taken_bytes < TAKEN_MAX, f"{reading.taken_bytes / 2**20:.0f} MB"
    return reading


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", ["small", "within", "huge"])
def test_a_chunk_that_becomes_larger_than_it_says_is_refused_before_it_is(
    tmp_path: Path, compression: str, declared: str
) -> None:
    size = {"small": 1000, "within": CHUNK_BYTES_MAX, "huge": 2 * GIB}[declared]
    chunk = mcap_chunk(zeros(2 * GIB, compression), size, compression)
    path = mcap_file(tmp_path / "bomb.mcap", [chunk])
    assert path.stat().st_size < 20e6
    refused(path, "; no message can be read")


def test_a_chunk_whose_frame_claims_gigabytes_is_refused(tmp_path: Path) -> None:
    # A zstd frame of one block whose header says 8 GiB.
    content = bytearray(zstandard.ZstdCompressor().compress(bytes(1 << 17)))
    frame = b"\x28\xb5\x2f\xfd\xc0\x60" + (8 * GIB).to_bytes(8, "little") + content[-8:]
    path = mcap_file(tmp_path / "bomb.mcap", [mcap_chunk(frame, 8 * GIB - 1, "zstd")])
    refused(path, "uncompressed_size: 8589934591 bytes; expected")
    path = mcap_file(tmp_path / "bomb.mcap", [mcap_chunk(frame, 1 << 17, "zstd")])
    refused(path, "; no message can be read")


@pytest.mark.parametrize(
    "pattern",
    [b"\0", mcap_record(Opcode.MESSAGE, bytes(23)), mcap_record(200, b"")],
    ids=["zeros", "messages", "unknown"],
)
def test_millions_of_empty_records_in_a_chunk_cost_the_chunk(tmp_path: Path, pattern: bytes) -> None:
    content = pattern * ((CHUNK_BYTES_MAX - 64) // len(pattern))
    compressed = zstandard.ZstdCompressor(level=3).compress(content)
    chunks = [mcap_chunk(compressed, len(content), "zstd")] * 8  # 1 GiB
    refused(mcap_file(tmp_path / "many.mcap", chunks), "records: expected 262144 at most")


def test_a_chunk_that_is_refused_is_named_and_the_frames_around_it_are_read(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(3))
    content = path.read_bytes()
    bomb = mcap_chunk(lz4.frame.compress(bytes(1 << 24)), 1000, "lz4")
    end = content.rindex(mcap_record(Opcode.DATA_END, bytes(4))[:9])
    path.write_bytes(content[:end] + bomb + content[end:])
    reading = read_bounded(path)
    assert reading.frames == 3
    (error,) = reading.errors
    assert "uncompressed_size: 1000 bytes are declared, more are there" in error


def test_a_message_that_is_shorter_than_its_head_is_passed_over(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(3))
    content = path.read_bytes()
    short = mcap_record(Opcode.MESSAGE, bytes(21))
    end = content.rindex(mcap_record(Opcode.DATA_END, bytes(4))[:9])
    path.write_bytes(content[:end] + mcap_chunk(short, len(short), "") + content[end:])
    reading = read_bounded(path)
    assert (reading.frames, reading.errors) == (3, [])


def test_images_without_partners_that_fill_the_memory_are_dropped(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(2))
    content = path.read_bytes()
    with path.open("rb") as stream:
        channels = [record for record in StreamReader(stream).records if isinstance(record, Channel)]
    (depth,) = {channel.id for channel in channels if channel.topic == ros.DEPTH_TOPIC}
    chunks = []
    for second in range(8):
        logged_ns = (1000 + second) * 1_000_000_000
        head = struct.pack("<HIQQ", depth, 0, logged_ns, 0) + b"\0\1\0\0"
        head += struct.pack("<iI", 1000 + second, 0)
        message = mcap_record(Opcode.MESSAGE, head + bytes(100 << 20))
        chunks.append(mcap_chunk(zstandard.ZstdCompressor().compress(message), len(message), "zstd"))
    end = content.rindex(mcap_record(Opcode.DATA_END, bytes(4))[:9])
    path.write_bytes(content[:end] + b"".join(chunks) + content[end:])
    reading = read_bounded(path)
    assert reading.frames == 2
    assert reading.taken_bytes < TAKEN_MAX, f"{reading.taken_bytes / 2**20:.0f} MB"


@pytest.mark.parametrize("kind", ["sensor_msgs/msg/Image", ros.TRANSFORMS])
def test_first_messages_that_fill_the_memory_are_passed_over(tmp_path: Path, kind: str) -> None:
    def written(record: Schema | Channel) -> bytes:
        builder = RecordBuilder()
        record.write(builder)
        return builder.end()

    schema = Schema(id=1, name=kind, encoding="ros2msg", data=ros.DEFINITIONS[kind].encode())
    records, chunks = [written(schema)], []
    if kind == ros.TRANSFORMS:
        names = struct.pack("<iI", 100, 0) + struct.pack("<I4sI4s", 4, b"abc", 4, b"def")
        pose = struct.pack("<7d", *[0.0] * 6, 1.0)
        body = struct.pack("<I", 60_000) + names + bytes(4) + pose + (names + pose) * 59_999
    else:
        body = struct.pack("<iI", 100, 0) + struct.pack("<I2s", 2, b"f")
        body = body.ljust(16, b"\0") + struct.pack("<III6s", 4, 4, 6, b"mono8") + b"\0\0"
        body += struct.pack("<II", 4, 60 << 20) + bytes(60 << 20)
    for number in range(1, 17):
        records.append(
            written(Channel(id=number, topic=f"/t{number}", message_encoding="cdr", schema_id=1, metadata={}))
        )
        message = mcap_record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, 0, 0) + b"\0\1\0\0" + body)
        chunks.append(mcap_chunk(zstandard.ZstdCompressor().compress(message), len(message), "zstd"))
    refused(mcap_file(tmp_path / "many.mcap", [*records, *chunks]), "no topic of depth images")


def test_schemas_that_fill_the_memory_chunk_by_chunk_are_refused(tmp_path: Path) -> None:
    chunks = []
    for number in range(1, 7):
        builder = RecordBuilder()
        Schema(id=number, name="a", encoding="ros2msg", data=bytes(15 << 20)).write(builder)
        content = builder.end()
        chunks.append(mcap_chunk(zstandard.ZstdCompressor().compress(content), len(content), "zstd"))
    refused(mcap_file(tmp_path / "many.mcap", chunks), "SCHEMA: over 67108864 bytes of schemas, channels")


def test_metadata_that_fill_the_memory_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "many.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number in range(6):
            writer.add_metadata(str(number), {"a": "b" * (15 << 20)})
        writer.finish()
    refused(path, "METADATA: over 67108864 bytes")


def test_a_file_that_was_made_longer_with_zeros_ends_where_it_was_written(tmp_path: Path, caplog) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(2))
    content = path.read_bytes()
    end = content.rindex(mcap_record(Opcode.DATA_END, bytes(4))[:9])
    path.write_bytes(content[:end])
    os.truncate(path, 64 * GIB)
    with open_source(path) as source:
        assert len(list(source)) == 2
    assert "is cut off" in caplog.text


@pytest.mark.parametrize("kind", [Opcode.SCHEMA, Opcode.CHUNK, Opcode.MESSAGE, Opcode.ATTACHMENT])
def test_a_record_of_gigabytes_is_not_read(tmp_path: Path, kind: int) -> None:
    path = tmp_path / "long.mcap"
    head = b"\x89MCAP0\r\n" + mcap_record(Opcode.HEADER, bytes(8))
    path.write_bytes(head + bytes([kind]) + (32 * GIB).to_bytes(8, "little"))
    os.truncate(path, len(head) + 9 + 32 * GIB)
    refused(path, "long.mcap: ")


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
def test_an_image_that_would_be_too_large_is_refused_by_its_header(
    tmp_path: Path, content: bytes, text: str
) -> None:
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


@pytest.mark.parametrize("name", ["a.mcap", "camera.toml"])
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
    "negative.yml": "%YAML:1.0\n---\nM1: !!opencv-matrix\n  rows: -3\n  cols: -3\n  dt: d\n"
    "  data: [1,2,3,4,5,6,7,8,9]\n",
    "repeated.yaml": 'camera_matrix: {rows: "a", cols: 4000000000, data: [1]}\n',
    "digits.yaml": f"image_width: {'9' * 5000}\nimage_height: 5\nk: [1,0,0,0,1,0,0,0,1]\n",
    "date.yaml": "k: [2001-99-99, 0,0,0,1,0,0,0,1]\nwidth: 1\nheight: 1\n",
    "tag.yaml": "k: !!python/object/apply:os.system ['true']\n",
    "key.yaml": "? [1, 2]\n: 3\n",
    "long.yaml": "k: [" + "1," * 200_000 + "1]",
    "nested.xml": "<?xml version='1.0'?><opencv_storage>" + "<a>" * 100_000,
    "nested_rgb.xml": "<rgb>" * 50_000,
    "nested_whole.xml": f"<opencv_storage>{'<a>' * 30_000}{'</a>' * 30_000}</opencv_storage>",
    "overlap.xml": "<?xml version='1.0'?><opencv_storage><M1 type_id='opencv-matrix'><rows>300000</rows>"
    "<cols>300</cols><dt>d</dt><data>1. 2.</data></M1></opencv_storage>",
    "entities.xml": "<!DOCTYPE a [<!ENTITY a 'aaaaaaaaaa'>]><rgb>&a;</rgb>",
    "digits.txt": f"{'9' * 5000} 0 1\n0 1 1\n0 0 1\n",
    "nested.toml": "registered = " + "[" * 50_000,
    "digits.toml": f"depth_scale = {'9' * 5000}",
    "hexadecimal.toml": f"depth_scale = 0x{'f' * 4000}",
    "registered.toml": f"registered = 0x{'f' * 4000}",
    "dotted.toml": ".".join(["a"] * 120_000) + " = 1",
    "wide.toml": "registered = true\n[color]\nwidth = 99999999999\nheight = 1\nfx=1\nfy=1\ncx=1\ncy=1\n",
    "large.toml": "# " + "x" * 10_000_000,
    "words.txt": "1 2 " + "x" * 200_000,
    "rows.txt": "1\n" * 100_000,
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


def test_a_hostile_calibration_in_a_replayed_folder_gets_the_same(tmp_path: Path) -> None:
    path = write_pairs(tmp_path, scenes(1), calibration=False)
    (path / "calibration.yml").write_text(CALIBRATIONS["brackets.yml"])
    refused(path, "calibration.yml: not valid YAML")


def tum_lines(folder: Path, list_name: str) -> list[list[str]]:
    return [line.split() for line in (folder / list_name).read_text().splitlines()[1:]]


def write_list(folder: Path, list_name: str, lines: list[list[str]]) -> None:
    (folder / list_name).write_text("".join(f"{' '.join(line)}\n" for line in lines))


def test_the_lists_of_a_tum_folder_lead_nowhere_else(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "tum", scenes(6))
    lines = tum_lines(folder, "depth.txt")
    outside = tmp_path / "outside.png"
    outside.write_bytes((folder / lines[0][1]).read_bytes())
    os.mkfifo(folder / "fifo.png")
    (folder / "zero.png").symlink_to("/dev/zero")
    (folder / "link.png").symlink_to(outside)
    for line, name in zip(
        lines, [str(outside), "../outside.png", "fifo.png", "zero.png", "link.png"], strict=False
    ):
        line[1] = name
    write_list(folder, "depth.txt", lines)
    reading = read_bounded(folder)
    assert reading.frames == 1
    leads_out = "the image is outside the recording's folder"
    for error, text in zip(
        reading.errors, [leads_out, leads_out, "not a regular file", leads_out, leads_out], strict=True
    ):
        assert text in error


BAD_STAMPS = ["-5.0", "1e999999999", "9" * 5000, "nan", "1e15", "0x5", "1_0e300000"]


@pytest.mark.parametrize("stamp", BAD_STAMPS)
def test_a_stamp_out_of_bounds_costs_its_frame(tmp_path: Path, stamp: str, caplog) -> None:
    folder = write_tum(tmp_path, scenes(3))
    lines = tum_lines(folder, "depth.txt")
    lines[1][0] = stamp
    write_list(folder, "depth.txt", lines)
    with open_source(folder) as source:
        assert len(list(source)) == 2
        assert source.metadata["dropped"] == "2"
    assert "depth.txt: line 2: expected 'seconds file', got '" in caplog.text
    assert "1 lines are skipped" in caplog.text


def test_a_name_of_thousands_of_characters_costs_its_frame(tmp_path: Path, caplog) -> None:
    folder = write_tum(tmp_path, scenes(3))
    lines = tum_lines(folder, "depth.txt")
    lines[1][1] = "x" * 5000
    write_list(folder, "depth.txt", lines)
    with open_source(folder) as source:
        assert len(list(source)) == 2
    assert "depth.txt: line 2: expected 'seconds file'" in caplog.text
    assert len(caplog.text) < 1000


def test_a_nul_in_a_name_costs_its_frame(tmp_path: Path) -> None:
    folder = write_tum(tmp_path, scenes(3))
    lines = tum_lines(folder, "depth.txt")
    lines[1][1] = "depth/\0.png"
    write_list(folder, "depth.txt", lines)
    reading = read_bounded(folder)
    assert reading.frames == 2
    assert "'depth/\\x00.png': not the name of an image" in reading.errors[0]


def test_a_list_of_one_moment_over_and_over_takes_neither_time_nor_memory(tmp_path: Path) -> None:
    folder = write_tum(tmp_path, scenes(2))
    for name in ("rgb.txt", "depth.txt"):
        ((stamp, image), last) = tum_lines(folder, name)
        same = [[stamp, image]] * 50_000
        near = [[f"{stamp}{n:05}", image] for n in range(50_000)]
        write_list(folder, name, [*same, *near, last])
    reading = read_bounded(folder, frames_most=3)
    assert reading.frames == 3
    assert reading.taken_bytes < TAKEN_MAX


def test_a_list_that_is_too_long_is_refused(tmp_path: Path) -> None:
    folder = write_tum(tmp_path, scenes(1))
    (folder / "rgb.txt").write_text("1 a\n" * 600_000)
    refused(folder, "rgb.txt: expected 500000 lines at most, got 600000")
    os.truncate(folder / "rgb.txt", 8 * GIB)
    refused(folder, "rgb.txt: the list has 8589934592 bytes; expected 16777216 at most")


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


def rewritten(
    path: Path,
    *,
    schema: Callable[[bytes], bytes] = bytes,
    message: Callable[[int, bytes], bytes] = lambda _, content: content,
) -> Path:
    """Copy a recording, its schemas' texts and its depth messages (by number) changed on the way."""
    with path.open("rb") as stream:
        records = list(StreamReader(stream).records)
    depth = next(
        record.id for record in records if isinstance(record, Channel) and record.topic == ros.DEPTH_TOPIC
    )
    other = path.with_name("b.mcap")
    number = 0
    with other.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        for record in records:
            if isinstance(record, Schema):
                writer.register_schema(record.name, record.encoding, schema(record.data))
            elif isinstance(record, Channel):
                writer.register_channel(record.topic, record.message_encoding, record.schema_id)
            elif isinstance(record, Message):
                data = record.data
                if record.channel_id == depth:
                    data = message(number, data)
                    number += 1
                writer.add_message(record.channel_id, record.log_time, data, record.publish_time)
            elif isinstance(record, DataEnd):
                break
        writer.finish()
    return other


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (b"string encoding\n", b"string encodimg\n", "field 4: expected 'string encoding'"),
        (b"uint8[] data\n", b"uint8[4] dat\n", "expected 'uint8[] data', got 'uint8[4] dat'"),
        (b"uint32 nanosec\n", b"uint64 nanosec\n", "Time 2: expected 'uint32 nanosec', got 'uint64 nanosec'"),
    ],
)
def test_a_schema_that_lacks_a_field_is_named(tmp_path: Path, old: bytes, new: bytes, text: str) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(1), "raw")
    other = rewritten(path, schema=lambda content: content.replace(old, new))
    with pytest.raises(RecordingFormatError, match=r"b\.mcap: no topic of depth images") as found:
        open_source(other)
    assert text in str(found.value)


def test_the_time_of_the_log_stands_in_for_a_stamp_before_1970(tmp_path: Path, caplog) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(3), "raw")
    early = (-7).to_bytes(4, "little", signed=True)
    other = rewritten(path, message=lambda number, data: data[:4] + early + data[8:] if number == 1 else data)
    read, errors = frames_and_errors(other)
    assert errors == []
    assert [frame.timestamp_ns for frame in read] == [scene.timestamp_ns for scene in scenes(3)]
    # Seven seconds before, and the nanoseconds of the second frame.
    assert "the stamp -7.033333333 s is wrong" in caplog.text
