"""Bags of ROS 2 in SQLite databases: the frames of the same messages in MCAP, and files that are no bags."""

import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
import zstandard
from database_bag import TABLES, to_database
from recorded_scene import APART, scenes, write_mcap

from nurbseg.common.errors import DriverError, EndOfRecordingError, FrameFormatError
from nurbseg.drivers import RecordingFormatError, open_source
from nurbseg.drivers.mcap.bags import database
from nurbseg.drivers.mcap.bags.database import DatabaseFile
from nurbseg.drivers.mcap.scan import list_streams
from nurbseg.drivers.options import SourceOptions

FRAMES = 6


@pytest.fixture(scope="module")
def mcap(tmp_path_factory):
    frames = scenes(FRAMES, APART)
    pose = np.eye(4)
    frames[1] = replace(frames[1], world_from_camera=pose, gravity=[0, 1, 0])
    return write_mcap(tmp_path_factory.mktemp("mcap") / "a.mcap", frames, "jpeg95")


@pytest.fixture
def bag(mcap, tmp_path):
    return to_database(mcap, tmp_path / "a.db3")


def assert_same(one, other):
    assert (one.index, one.timestamp_ns) == (other.index, other.timestamp_ns)
    for name in ("depth_mm", "color", "labels"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.calibration.color_from_depth, other.calibration.color_from_depth)
    np.testing.assert_array_equal(one.calibration.depth.matrix, other.calibration.depth.matrix)


@pytest.mark.parametrize(
    "how",
    [{}, {"definitions": True}, {"packed": zstandard.ZstdCompressor().compress}],
    ids=["plain", "definitions", "compressed"],
)
def test_the_frames_are_those_of_the_same_messages_in_mcap(mcap, tmp_path, how):
    path = to_database(mcap, tmp_path / "a b?#%.db3", **how)
    with open_source(mcap) as expected, open_source(path) as source:
        assert source.metadata["format"] == "ROS 2 bag (.db3)"
        frames = list(source)
        for one, other in zip(expected, frames, strict=True):
            assert_same(one, other)
        source.seek(2)
        assert_same(source.read(), frames[2])
    assert list(tmp_path.iterdir()) == [path]


def test_another_thread_reads_it(bag):
    numbers = []
    with open_source(bag) as source:
        thread = threading.Thread(target=lambda: numbers.extend(frame.index for frame in source))
        thread.start()
        thread.join()
    assert numbers == list(range(FRAMES))


def test_topics_are_listed_and_chosen_as_in_mcap(mcap, bag, tmp_path):
    assert list_streams(bag) == list_streams(mcap)
    with pytest.raises(RecordingFormatError, match=r"--depth-topic /none: no such topic; topics: /tf_static"):
        open_source(bag, SourceOptions(depth_topic="/none"))


@pytest.mark.parametrize("with_metadata", [True, False])
def test_a_split_one_is_one_recording(mcap, tmp_path, with_metadata):
    folder = tmp_path / "bag"
    folder.mkdir()
    whole = to_database(mcap, tmp_path / "whole.db3")
    with sqlite3.connect(whole) as base:
        (middle,) = base.execute("SELECT timestamp FROM messages ORDER BY id LIMIT 1 OFFSET 20").fetchone()
    base.close()
    names = ["b_0.db3", "b_1.db3"] if not with_metadata else ["late.db3", "early.db3"]
    for name, comparison in zip(names, ("<", ">="), strict=True):
        shutil.copy(whole, folder / name)
        with sqlite3.connect(folder / name) as base:
            base.execute(f"DELETE FROM messages WHERE NOT timestamp {comparison} ?", (middle,))
        base.close()
    if with_metadata:
        text = "rosbag2_bagfile_information:\n  relative_file_paths:\n    - late.db3\n    - early.db3\n"
        (folder / "metadata.yaml").write_text(text)
    with open_source(mcap) as expected, open_source(folder) as source:
        for one, other in zip(expected, source, strict=True):
            assert_same(one, other)


def test_one_that_is_written_to_is_read_with_what_was_not_merged_yet(bag):
    writer = sqlite3.connect(bag)
    try:
        writer.execute("PRAGMA journal_mode=WAL")
        writer.execute("DELETE FROM messages WHERE timestamp = (SELECT max(timestamp) FROM messages)")
        writer.commit()
        with open_source(bag) as source:
            assert len(list(source)) == FRAMES - 1
    finally:
        writer.close()


def test_what_a_recorder_that_was_killed_left_beside_it_is_not_needed_if_it_is_empty(bag):
    for end in ("-wal", "-shm"):
        bag.with_name(bag.name + end).touch()
    with open_source(bag) as source:
        assert len(list(source)) == FRAMES
    assert bag.with_name(bag.name + "-shm").stat().st_size == 0


@pytest.mark.parametrize("share", [0.5, 0.7, 0.9])
def test_one_that_is_cut_off_is_replayed_as_far_as_it_goes(bag, mcap, share, caplog):
    content = bag.read_bytes()
    bag.write_bytes(content[: round(share * len(content))])
    with open_source(mcap) as expected, open_source(bag) as source:
        frames = list(source)
        assert source.metadata["whole"] == "false"
        assert 0 < len(frames) < FRAMES
        for one, other in zip(expected, frames, strict=False):
            np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
    assert "replayed up to there" in caplog.text


def change(path, *statements, values=()):
    with sqlite3.connect(path) as base:
        for statement in statements:
            base.execute(statement, values if "?" in statement else ())
    base.close()


def emptied(path, *statements):
    path.unlink()
    change(path, *statements)


_ENDLESS = "WITH RECURSIVE n(i) AS (VALUES(0) UNION ALL SELECT i+1 FROM n) SELECT i, 1, i, x'00' FROM n"
_NO_BAG = r"not a bag of ROS 2: "
#: What is done to a bag, and what is said of it.
REFUSED = {
    "no tables": (
        lambda p: emptied(p, "CREATE TABLE a(b)"),
        _NO_BAG + "topics: expected a table, got nothing",
    ),
    "a view of endless messages": (
        lambda p: change(
            p, "DROP TABLE messages", f"CREATE VIEW messages(id, topic_id, timestamp, data) AS {_ENDLESS}"
        ),
        _NO_BAG + "messages: expected a table, got view",
    ),
    "a virtual table": (
        lambda p: change(
            p, "DROP TABLE messages", "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)"
        ),
        _NO_BAG + "messages: expected a table, got a table of another kind",
    ),
    "a computed column": (
        lambda p: emptied(
            p,
            TABLES[0],
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB AS (zeroblob(1000000000)) VIRTUAL)",
            "INSERT INTO messages VALUES (1, 1, 1)",
        ),
        _NO_BAG + "messages: expected a column data",
    ),
    "no column": (
        lambda p: change(p, "ALTER TABLE messages RENAME COLUMN timestamp TO time"),
        _NO_BAG + "messages: expected a column timestamp",
    ),
    "no row numbers": (
        lambda p: emptied(
            p,
            TABLES[0],
            "CREATE TABLE messages(topic_id INTEGER PRIMARY KEY, timestamp INTEGER, data BLOB) WITHOUT ROWID",
        ),
        _NO_BAG + "messages: expected a table, got a table of another kind",
    ),
    "topics without names": (
        lambda p: change(p, "UPDATE topics SET name = x'ff'"),
        "topics: expected a number and text",
    ),
    "times that are text": (
        lambda p: change(p, "UPDATE messages SET timestamp = 'noon'"),
        "messages: expected whole numbers, got",
    ),
    "times that are fractions": (
        lambda p: change(p, "UPDATE messages SET timestamp = 1.5"),
        "messages: expected whole numbers, got",
    ),
    "no topics": (lambda p: change(p, "DELETE FROM topics"), "no topic of depth images"),
    "no messages": (lambda p: change(p, "DELETE FROM messages"), "no topic of depth images"),
    "other types": (lambda p: change(p, "UPDATE topics SET type = 'a/msg/B'"), "no topic of depth images"),
    "another encoding": (
        lambda p: change(p, "UPDATE topics SET serialization_format = 'cbor'"),
        "encoded as cbor; only ROS 2's cdr is read",
    ),
    "messages that are no bytes": (lambda p: change(p, "UPDATE messages SET data = 7"), "no topic of depth"),
    "messages that are text": (lambda p: change(p, "UPDATE messages SET data = 'a'"), "no topic of depth"),
    "messages of noise": (
        lambda p: change(p, "UPDATE messages SET data = randomblob(200)"),
        "no topic of depth images",
    ),
    "messages of nothing": (
        lambda p: change(p, "UPDATE messages SET data = x''"),
        "no topic of depth images",
    ),
    "a compressed message that is cut off": (
        lambda p: change(p, "UPDATE messages SET data = x'28b52ffd0458'"),
        "no topic of depth images",
    ),
    "other definitions": (
        lambda p: change(
            p,
            "CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)",
            "INSERT INTO message_definitions SELECT DISTINCT type, 'ros2msg', 'int8 other' FROM topics",
        ),
        "expected '.*', got 'int8 other'",
    ),
    "a number of messages without end": (
        lambda p: change(
            p,
            "INSERT INTO messages WITH RECURSIVE n(i) AS (VALUES(0) UNION ALL SELECT i+1 FROM n LIMIT 3000) "
            "SELECT NULL, 1, i, x'00' FROM n",
        ),
        "messages: expected 2000 at most",
    ),
    "a head alone": (lambda p: p.write_bytes(p.read_bytes()[:100]), "the ROS 2 database cannot be read"),
    "noise after the head": (
        lambda p: p.write_bytes(p.read_bytes()[:16] + np.random.default_rng(1).bytes(5000)),
        "the ROS 2 database cannot be read",
    ),
    "a schema that cannot be parsed": (
        lambda p: change(p, "PRAGMA writable_schema=ON", "UPDATE sqlite_master SET sql = 'CREATE TABLE ('"),
        _NO_BAG + "topics: expected a column id",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_bag_is_refused(bag, what, monkeypatch):
    monkeypatch.setattr(database, "MESSAGES_MAX", 2000)
    spoil, message = REFUSED[what]
    try:
        spoil(bag)
    except sqlite3.OperationalError as err:
        pytest.skip(f"this SQLite cannot make it: {err}")
    with pytest.raises(RecordingFormatError, match=message) as raised:
        open_source(bag)
    assert str(bag) in str(raised.value)


#: What is done to a bag that can be replayed in spite of it.
TOLERATED = {
    "times before 1970": ("UPDATE messages SET timestamp = timestamp - 4000000000000000000",),
    "one message that is no bytes": ("UPDATE messages SET data = 7 WHERE id = 25",),
    "a topic twice": ("INSERT INTO topics SELECT 77, name, type, 'cdr', '' FROM topics WHERE id = 1",),
    "messages of no topic": ("INSERT INTO messages VALUES (NULL, 99, 5, x'00')",),
    "a trigger": ("CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END",),
    "no format stated": ("ALTER TABLE topics DROP COLUMN serialization_format",),
    "names that are not UTF-8": ("INSERT INTO topics VALUES (88, CAST(x'ff2f' AS TEXT), 'a', 'cdr', '')",),
}


@pytest.mark.parametrize("what", TOLERATED)
def test_what_is_odd_costs_a_frame_at_most(bag, what):
    change(bag, *TOLERATED[what])
    with open_source(bag) as source:
        assert len(list(source)) >= FRAMES - 1


def test_a_compressed_message_of_any_size_takes_little_memory(bag):
    packer = zstandard.ZstdCompressor().compressobj()
    bomb = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1 << 11)) + packer.flush()
    change(bag, "UPDATE messages SET data = ?", values=(bomb,))
    code = f"""
import resource
from nurbseg.drivers import open_source, RecordingFormatError
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    open_source({str(bag)!r})
except RecordingFormatError as err:
    print("no topic of depth" in str(err), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    refused, kilobytes = done.stdout.split()
    assert refused == "True"
    assert int(kilobytes) < 700_000


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.db3")
    with pytest.raises(RecordingFormatError, match="not a regular file"):
        DatabaseFile(tmp_path / "a.db3")


def test_a_query_that_never_ends_is_given_up(bag, monkeypatch):
    monkeypatch.setattr(database, "_INSTRUCTIONS", 64)
    with pytest.raises(RecordingFormatError, match="takes too long"):
        open_source(bag)


def test_a_message_that_is_gone_costs_its_frame(bag):
    """The file is changed after it was opened; what it says is checked again at each message."""
    with DatabaseFile(bag) as file:
        file.find_messages()
        with pytest.raises(FrameFormatError, match="message 9999: data: expected bytes"):
            file.message(0, 9999)


def test_a_reader_that_is_closed_says_so(bag):
    with open_source(bag) as source:
        while True:
            try:
                source.read()
            except EndOfRecordingError:
                break
    with pytest.raises(DriverError, match="closed"):
        source.read()
