"""Bags of ROS: folders of several files, databases and files of ROS 1, and those that are refused."""

import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from bounded_child import read_bounded
from database_bag import TABLES
from recorded_forms import FRAMES, database, list_parts, robot, split
from recorded_scene import APART, scenes
from ros1_bag import to_ros1

from nurbseg.drivers import CalibrationError, RecordingFormatError, SourceOptions, open_source


@pytest.fixture
def ride(tmp_path: Path) -> Path:
    """A bag of 12 files with a frame each, the first of which has the cameras."""
    return split(tmp_path, scenes(FRAMES, APART))


def count(path: Path, options: SourceOptions | None = None) -> int:
    with open_source(path, options) as source:
        return len(list(source))


@pytest.mark.parametrize("listed", [False, True])
def test_a_missing_part_is_said_and_costs_its_frames(ride: Path, listed: bool, caplog) -> None:
    (ride / "ride_3.mcap").unlink()
    if listed:
        list_parts(ride, [f"ride_{number}.mcap" for number in range(12)])
    assert count(ride) == FRAMES - 1
    assert "1 parts of the recording are missing: ride_3.mcap" in caplog.text


def test_a_later_part_by_itself_asks_for_the_folder(ride: Path) -> None:
    alone = ride / "ride_7.mcap"
    with pytest.raises(CalibrationError, match=r"no sensor_msgs/CameraInfo .*later part .*ride\)"):
        open_source(alone)
    assert count(alone, SourceOptions(calibration=APART)) == 1


def test_a_message_of_a_database_that_is_damaged_costs_its_frame(tmp_path: Path) -> None:
    path = database(tmp_path, scenes(FRAMES, APART))
    with sqlite3.connect(path) as base:
        ((topic,),) = base.execute("SELECT id FROM topics WHERE name LIKE '%depth%image%'")
        found = base.execute("SELECT id FROM messages WHERE topic_id = ? ORDER BY id", (topic,))
        places = [place for (place,) in found]
        # As ros2 bag compresses messages, but cut off; and no bytes.
        base.execute("UPDATE messages SET data = ? WHERE id = ?", (zstandard.compress(b"a")[:6], places[3]))
        base.execute("UPDATE messages SET data = 7 WHERE id = ?", (places[5],))
    base.close()
    errors: list[str] = []
    with open_source(path) as source:
        stamps = [frame.timestamp_ns for frame in source.frames(lambda err: errors.append(str(err)))]
    assert stamps == [scene.timestamp_ns for scene in scenes(FRAMES) if scene.index not in (3, 5)]
    assert len(errors) == 2
    assert all(f"message {places[n]}: damaged" in err for n, err in zip((3, 5), errors, strict=True))


def test_compressed_parts_are_refused_with_the_command_that_unpacks_them(ride: Path) -> None:
    for path in ride.glob("*.mcap"):
        path.rename(path.with_name(f"{path.name}.zstd"))
    with pytest.raises(RecordingFormatError, match=r"ride_0.mcap.zstd: .*zstd -d .*ride_10\.mcap\.zstd"):
        open_source(ride)


def test_metadata_that_are_damaged_are_named(ride: Path) -> None:
    (ride / "metadata.yaml").write_text("a: [")
    with pytest.raises(RecordingFormatError, match=r"metadata\.yaml: not valid YAML"):
        open_source(ride)
    (ride / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    assert count(ride) == FRAMES


def test_two_recordings_in_a_folder_are_refused(ride: Path) -> None:
    for path in sorted(ride.glob("*.mcap"))[1:]:
        path.unlink()
    assert count(ride) == 1
    (ride / "other.mcap").write_bytes((ride / "ride_0.mcap").read_bytes())
    with pytest.raises(RecordingFormatError, match="2 recordings"):
        open_source(ride)


@pytest.fixture
def base(tmp_path: Path) -> Path:
    return database(tmp_path, scenes(FRAMES, APART))


def change(path: Path, *statements: str, values: tuple[bytes, ...] = ()) -> None:
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement, values if "?" in statement else ())
    connection.close()


def emptied(path: Path, *statements: str) -> None:
    path.unlink()
    change(path, *statements)


def test_another_thread_reads_a_database_with_odd_times_and_messages_of_no_topic(base: Path) -> None:
    change(
        base,
        "UPDATE messages SET timestamp = timestamp - 4000000000000000000",
        "INSERT INTO messages VALUES (NULL, 99, 5, x'00')",
    )
    numbers: list[int] = []
    with open_source(base) as source:
        thread = threading.Thread(target=lambda: numbers.extend(frame.index for frame in source))
        thread.start()
        thread.join()
    assert numbers == list(range(FRAMES))


def test_one_that_is_written_to_is_read_with_what_was_not_merged_yet(base: Path) -> None:
    writer = sqlite3.connect(base)
    try:
        writer.execute("PRAGMA journal_mode=WAL")
        writer.execute("DELETE FROM messages WHERE timestamp = (SELECT max(timestamp) FROM messages)")
        writer.commit()
        assert count(base) == FRAMES - 1
    finally:
        writer.close()


def test_what_a_recorder_that_was_killed_left_beside_a_database_is_not_needed_if_it_is_empty(base):
    for end in ("-wal", "-shm"):
        base.with_name(base.name + end).touch()
    assert count(base) == FRAMES
    assert base.with_name(base.name + "-shm").stat().st_size == 0


_ENDLESS = "WITH RECURSIVE n(i) AS (VALUES(0) UNION ALL SELECT i+1 FROM n) SELECT i, 1, i, x'00' FROM n"
#: What is done to a database that then is no bag.
NO_BAGS: dict[str, Callable[[Path], object]] = {
    "no tables": lambda p: emptied(p, "CREATE TABLE a(b)"),
    "a view of endless messages": lambda p: change(
        p, "DROP TABLE messages", f"CREATE VIEW messages(id, topic_id, timestamp, data) AS {_ENDLESS}"
    ),
    "a virtual table": lambda p: change(
        p, "DROP TABLE messages", "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)"
    ),
    "a computed column": lambda p: emptied(
        p,
        TABLES[0],
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB AS (zeroblob(1000000000)) VIRTUAL)",
        "INSERT INTO messages VALUES (1, 1, 1)",
    ),
    "no column": lambda p: change(p, "ALTER TABLE messages RENAME COLUMN timestamp TO time"),
    "times that are text": lambda p: change(p, "UPDATE messages SET timestamp = 'noon'"),
    "no topics": lambda p: change(p, "DELETE FROM topics"),
    "no messages": lambda p: change(p, "DELETE FROM messages"),
    "other types": lambda p: change(p, "UPDATE topics SET type = 'a/msg/B'"),
    "another encoding": lambda p: change(p, "UPDATE topics SET serialization_format = 'cbor'"),
    "messages that are no bytes": lambda p: change(p, "UPDATE messages SET data = 7"),
    "messages of noise": lambda p: change(p, "UPDATE messages SET data = randomblob(200)"),
    "a packed message of gigabytes": lambda p: change(p, "UPDATE messages SET data = ?", values=(bomb(),)),
    "a schema that is no UTF-8": lambda p: change(
        p,
        "PRAGMA writable_schema=ON",
        "UPDATE sqlite_master SET sql = 'CREATE TABLE (', name = CAST(x'f428' AS TEXT)",
    ),
}


def bomb() -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(1 << 11)) + packer.flush()


@pytest.mark.parametrize("what", NO_BAGS)
def test_a_database_that_is_no_bag_is_refused_in_little_memory(base: Path, what: str) -> None:
    try:
        NO_BAGS[what](base)
    except sqlite3.OperationalError as err:
        pytest.skip(f"this SQLite cannot make it: {err}")
    reading = read_bounded(base)
    assert (reading.frames, len(reading.errors)) == (0, 1)
    assert f"Error: {base}: " in reading.errors[0]
    assert len(reading.errors[0]) < 1000
    assert reading.taken_bytes < 700_000_000


def test_a_recording_of_realsenses_older_sdk_is_named_with_what_converts_it(tmp_path: Path) -> None:
    """It keeps the place of its cameras in messages of its own, which are not read."""
    topics = {"/cam/depth/image_raw": "/device_0/sensor_0/Depth_0/image/data"}
    path = to_ros1(robot(tmp_path, scenes(3)), tmp_path / "a.bag", renamed=topics)
    with pytest.raises(RecordingFormatError, match=r"older RealSense SDK.*convert_bag_to_db3"):
        open_source(path)


def test_a_bag_of_ros_1_that_was_not_closed_is_refused_with_what_makes_its_index(tmp_path: Path) -> None:
    path = to_ros1(robot(tmp_path, scenes(3)), tmp_path / "a.bag")
    content = path.read_bytes()
    place = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:place] + bytes(8) + content[place + 8 :])
    with pytest.raises(RecordingFormatError, match=r"not indexed.*rosbag reindex"):
        open_source(path)
