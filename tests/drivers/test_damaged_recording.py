"""Recordings that are cut off or damaged: what can be replayed is, and the rest is said."""

import logging
import random
from pathlib import Path

import numpy as np
import pytest
from all_frames import frames_and_errors
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from recorded_scene import APART, scenes, write_mcap

from nurbseg.drivers import DriverError, FrameFormatError, RecordingFormatError, RGBDFrame, open_source
from nurbseg.drivers.mcap import ros_messages as ros

FRAMES = 40
LOGGER = "nurbseg.drivers"


@pytest.fixture(scope="module")
def frames() -> list[RGBDFrame]:
    return scenes(FRAMES, APART)


@pytest.fixture(scope="module", params=["zstd", "lz4", "none"])
def whole(request, tmp_path_factory, frames) -> Path:
    """One recording in each compression that MCAP knows, of several chunks."""
    from mcap.writer import CompressionType, Writer

    path = write_mcap(tmp_path_factory.mktemp("whole") / "zstd.mcap", frames, "raw")
    with path.open("rb") as stream:
        records = list(StreamReader(stream).records)
    other = path.with_name(f"{request.param}.mcap")
    kinds = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
    with other.open("wb") as stream:
        writer = Writer(stream, chunk_size=50_000, compression=kinds[request.param])
        writer.start(profile="ros2", library="test")
        schemas, channels = {}, {}
        for record in records:
            kind = type(record).__name__
            if kind == "Schema" and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif kind == "Channel" and record.id not in channels:
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id]
                )
            elif kind == "Message":
                writer.add_message(
                    channels[record.channel_id], record.log_time, record.data, record.publish_time
                )
        writer.finish()
    return other


def test_a_recording_whose_chunks_are_all_damaged_says_so(whole: Path, tmp_path: Path) -> None:
    content = bytearray(whole.read_bytes())
    with whole.open("rb") as stream:
        chunks = [
            record for record in StreamReader(stream, emit_chunks=True).records if isinstance(record, Chunk)
        ]
    assert len(chunks) > 1
    for chunk in chunks:
        place = content.index(chunk.data) + len(chunk.data) // 2
        content[place : place + 8] = bytes(each ^ 0xFF for each in content[place : place + 8])
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingFormatError, match=r"\.mcap: the chunk at .*; no message can be read"):
        open_source(str(path))


def last_whole_frame(path: Path, size: int) -> int:
    """How many frames have their depth message within the first bytes, by the library's own index."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    depth = next(number for number, channel in summary.channels.items() if channel.topic == ros.DEPTH_TOPIC)
    count = 0
    with path.open("rb") as stream:
        for index in summary.chunk_indexes:
            if index.chunk_start_offset + index.chunk_length <= size:
                stream.seek(index.chunk_start_offset)
                content = stream.read(index.chunk_length)
                records = StreamReader(_Bytes(content), skip_magic=True).records
                count += sum(
                    getattr(each, "channel_id", None) == depth and type(each).__name__ == "Message"
                    for each in _until_end(records)
                )
    return count


def _until_end(records):
    from mcap.exceptions import EndOfFile

    try:
        yield from records
    except EndOfFile:
        return


class _Bytes:
    def __init__(self, content: bytes) -> None:
        self._content, self._place = content, 0

    def read(self, length: int) -> bytes:
        part = self._content[self._place : self._place + length]
        self._place += len(part)
        return part


def replayed(path: Path) -> list[RGBDFrame]:
    with open_source(path) as source:
        return list(source)


def test_a_recording_cut_off_anywhere_replays_to_its_last_whole_frame(
    whole, frames, tmp_path, caplog
) -> None:
    content = whole.read_bytes()
    rng = random.Random(1)
    sizes = sorted({rng.randrange(8, len(content)) for _ in range(80)} | {8, 9, len(content) - 1})
    counts = []
    for size in sizes:
        path = tmp_path / "cut.mcap"
        path.write_bytes(content[:size])
        expected = last_whole_frame(whole, size)
        caplog.clear()
        with caplog.at_level(logging.WARNING, LOGGER):
            try:
                read = replayed(path)
            except RecordingFormatError as err:
                assert "cut off" in str(err)
                read = []
        assert "is cut off after" in caplog.text
        assert len(read) >= expected, f"at {size} of {len(content)} bytes"
        for frame, written in zip(read, frames, strict=False):
            np.testing.assert_array_equal(frame.depth_mm, written.depth_mm)
            np.testing.assert_array_equal(frame.color, written.color)
            assert frame.timestamp_ns == written.timestamp_ns
        counts.append(len(read))
    assert counts == sorted(counts)
    assert counts[-1] == FRAMES


def test_without_compression_a_frame_is_replayed_as_soon_as_its_last_byte_is_there(frames, tmp_path) -> None:
    path = tmp_path / "whole.mcap"
    from mcap.writer import CompressionType, Writer

    source = write_mcap(tmp_path / "source.mcap", frames[:6], "raw")
    with source.open("rb") as stream, path.open("wb") as out:
        writer = Writer(out, chunk_size=10_000_000, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="test")
        for record in StreamReader(stream).records:
            kind = type(record).__name__
            if kind == "DataEnd":
                break
            if kind == "Schema":
                writer.register_schema(record.name, record.encoding, record.data)
            elif kind == "Channel":
                writer.register_channel(record.topic, record.message_encoding, record.schema_id)
            elif kind == "Message":
                writer.add_message(record.channel_id, record.log_time, record.data, record.publish_time)
        writer.finish()
    content = path.read_bytes()
    ends = [content.index(frame.depth_mm.tobytes()) + frame.depth_mm.nbytes for frame in frames[:6]]
    for number, end in enumerate(ends[1:], 1):
        for size, expected in ((end - 1, number), (end, number + 1)):
            cut = tmp_path / "cut.mcap"
            cut.write_bytes(content[:size])
            assert len(replayed(cut)) == expected


def test_a_damaged_chunk_is_named_and_the_run_continues(whole, frames, tmp_path) -> None:
    content = bytearray(whole.read_bytes())
    with whole.open("rb") as stream:
        chunks = [chunk for chunk in _chunks(stream)]
    start, length = chunks[len(chunks) // 2]
    content[start + length // 2] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    read, errors = frames_and_errors(path)
    assert len(errors) == 1
    assert f"damaged.mcap: the chunk at byte {start}" in errors[0]
    assert FRAMES - 10 < len(read) < FRAMES
    stamps = {frame.timestamp_ns: frame for frame in frames}
    for frame in read:
        np.testing.assert_array_equal(frame.depth_mm, stamps[frame.timestamp_ns].depth_mm)


def _chunks(stream):
    """The place and length of each chunk's content."""
    place = stream.seek(8)
    while head := stream.read(9):
        length = int.from_bytes(head[1:], "little")
        place += 9
        if head[0] == Opcode.FOOTER:
            return
        if head[0] == Opcode.CHUNK:
            yield place, length
        place = stream.seek(place + length)


def test_bytes_changed_at_random_never_lead_to_anything_but_typed_errors(whole, tmp_path) -> None:
    content = whole.read_bytes()
    rng = random.Random(2)
    path = tmp_path / "changed.mcap"
    for _ in range(60):
        changed = bytearray(content)
        for _ in range(rng.choice([1, 3, 30])):
            # Most of them where the structure is, at the beginning and the end.
            near = rng.choice([200, 5000, len(content)])
            changed[rng.choice([rng.randrange(near), -1 - rng.randrange(near)])] = rng.randrange(256)
        path.write_bytes(changed)
        try:
            source = open_source(path)
        except DriverError as err:
            assert "changed.mcap" in str(err)
            continue
        with source:
            for _ in range(3 * FRAMES):
                try:
                    source.read()
                except FrameFormatError:
                    continue
                except EOFError:
                    break


def test_a_file_that_ends_before_its_first_frame_says_so(whole, tmp_path) -> None:
    path = tmp_path / "short.mcap"
    path.write_bytes(whole.read_bytes()[:60])
    with pytest.raises(RecordingFormatError, match=r"short\.mcap: the recording is cut off before"):
        open_source(path)
