"""Files are written where others may have put links and pipes; nothing else is written or waited for."""

from __future__ import annotations

import os
import socket
import threading
import time
from pathlib import Path

import pytest

from nurbseg.common import files
from nurbseg.common.files import append, check_absent, create_private, replacing, write_atomically


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    path = tmp_path / "victim"
    path.write_bytes(b"precious")
    return path


def test_links_that_are_planted_are_not_followed(
    tmp_path: Path, victim: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "shared"
    folder.mkdir()
    path = folder / "out.json"
    for name in ("out.json", f".out.json.{os.getpid()}.part", ".out.json.0000.part"):
        (folder / name).symlink_to(victim)
    # Even if somebody knew the name.
    names = iter(["0000", "1111"])
    monkeypatch.setattr(files.secrets, "token_hex", lambda _: next(names))
    with pytest.raises(FileExistsError, match=r"out\.json'$"):
        write_atomically(path, b"new")
    write_atomically(path, b"new")
    assert victim.read_bytes() == b"precious"
    assert (path.read_bytes(), path.is_symlink()) == (b"new", False)


def test_the_unfinished_file_has_another_name_each_time(tmp_path: Path) -> None:
    names = set()
    for _ in range(3):
        with replacing(tmp_path / "out"):
            (name,) = tmp_path.iterdir()
            names.add(name)
        (tmp_path / "out").unlink()
    assert len(names) == 3


def test_a_file_that_is_not_written_to_its_end_leaves_the_old_one(victim: Path) -> None:
    with pytest.raises(ZeroDivisionError), replacing(victim) as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert victim.read_bytes() == b"precious"
    assert list(victim.parent.iterdir()) == [victim]


@pytest.mark.parametrize(("mode", "umask", "expected"), [(0o600, 0, 0o600), (0o666, 0o027, 0o640)])
def test_its_mode_is_the_one_asked_for(tmp_path: Path, mode: int, umask: int, expected: int) -> None:
    before = os.umask(umask)
    try:
        with replacing(tmp_path / "out", mode):
            pass
    finally:
        os.umask(before)
    assert (tmp_path / "out").stat().st_mode & 0o777 == expected


def test_names_of_any_length_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / ("é" * 127)
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"


@pytest.mark.parametrize("plant", [Path.symlink_to, Path.hardlink_to])
def test_nothing_is_added_to_what_a_file_was_replaced_by(tmp_path: Path, victim: Path, plant: object) -> None:
    path = tmp_path / "table.csv"
    write_atomically(path, b"a\n")
    append(path, b"b\n")
    assert path.read_bytes() == b"a\nb\n"
    path.unlink()
    plant(path, victim)  # type: ignore[operator]
    with pytest.raises(OSError, match="table"):
        append(path, b"c\n")
    assert victim.read_bytes() == b"precious"


def test_a_pipe_without_a_reader_is_waited_for_and_then_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.mcap"
    os.mkfifo(path)
    monkeypatch.setattr(files, "_READER_S", 0.3)
    begin_s = time.monotonic()
    with pytest.raises(OSError, match=r"is a pipe that no program has opened for reading within 0\.3 s"):
        create_private(path)
    assert time.monotonic() - begin_s < 5.0
    assert caplog.messages == [f"{path}: waiting up to 0.3 s for a program that reads this pipe"]


def test_a_pipe_whose_reader_comes_late_gets_everything(tmp_path: Path) -> None:
    path, read = tmp_path / "a.mcap", []
    os.mkfifo(path)
    reader = threading.Timer(0.3, lambda: read.append(path.read_bytes()))
    reader.start()
    with create_private(path) as file:
        # More than a pipe holds.
        file.write(bytes(1_000_000))
    reader.join(30.0)
    assert read == [bytes(1_000_000)]


def test_a_pipe_of_another_user_gets_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        monkeypatch.setattr(files.os, "geteuid", lambda: 12345)
        os.chown(path, 54321, -1) if os.getuid() == 0 else None
        with pytest.raises(FileExistsError):
            create_private(path)
    finally:
        os.close(reader)


def test_a_device_is_written_as_it_is() -> None:
    with create_private(Path("/dev/null")) as file:
        file.write(b"anything")


def test_what_would_replace_a_pipe_is_written_into_it(tmp_path: Path) -> None:
    path, read = tmp_path / "report.json", []
    os.mkfifo(path)
    reader = threading.Thread(target=lambda: read.append(path.read_bytes()))
    reader.start()
    # More than a pipe holds.
    write_atomically(path, bytes(1_000_000))
    reader.join(30.0)
    assert (read, path.is_fifo(), list(tmp_path.iterdir())) == ([bytes(1_000_000)], True, [path])


def test_a_reader_of_a_pipe_that_has_stopped_is_not_waited_for_forever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "report.json"
    os.mkfifo(path)
    monkeypatch.setattr(files, "_READER_S", 0.3)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with pytest.raises(OSError, match=r"has accepted nothing for 0\.3 s"):
            write_atomically(path, bytes(1_000_000))
    finally:
        os.close(reader)


@pytest.mark.parametrize("name", ["a folder", "a socket", "a link to a pipe"])
def test_neither_a_folder_nor_a_socket_is_an_output_even_if_it_may_be_replaced(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "a folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a link to a pipe").symlink_to("pipe")
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(tmp_path / "a socket"))
    before = os.lstat(tmp_path / name)
    for write in (lambda path: check_absent(path, force=True), lambda path: write_atomically(path, b"new")):
        with pytest.raises(OSError, match="name another file"):
            write(tmp_path / name)
    assert os.lstat(tmp_path / name).st_ino == before.st_ino
