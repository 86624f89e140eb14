"""A file behind a pipe, which takes everything whatever becomes of the file."""

import errno
import os
import threading
import time
from pathlib import Path

import pytest

from nurbseg.app.view.stream import PipedFile

LIMIT_S = 60.0


@pytest.mark.parametrize("size", [0, 1, 5_000_000])
def test_what_is_written_is_in_the_file(tmp_path: Path, size: int) -> None:
    content = bytes(range(256)) * (size // 256) + bytes(size % 256)
    piped = PipedFile(tmp_path / "file")
    with piped as path:
        writer = path.open("wb")
    with writer:
        writer.write(content)
        assert not piped.join(0.0)
    assert piped.join(LIMIT_S)
    assert piped.error is None
    assert (tmp_path / "file").read_bytes() == content


def test_a_full_disk_is_known_and_does_not_disturb_who_writes() -> None:
    piped = PipedFile(Path("/dev/full"))
    with piped as path, path.open("wb") as writer:
        for _ in range(50):
            writer.write(bytes(100_000))
    assert piped.join(LIMIT_S)
    assert piped.error is not None
    assert piped.error.errno == errno.ENOSPC


def test_a_writer_that_never_comes_is_not_waited_for(tmp_path: Path) -> None:
    before = threading.active_count()
    piped = PipedFile(tmp_path / "file")
    with piped:
        pass
    assert piped.join(LIMIT_S)
    assert threading.active_count() == before


def test_a_file_that_cannot_be_created_is_an_error_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="File exists"):
        PipedFile(tmp_path / "file" / "nowhere")
    with pytest.raises(FileExistsError, match="already exists"):
        PipedFile(tmp_path / "file")


def test_the_file_is_for_this_user_alone_and_its_folder_is_made(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file"
    before = os.umask(0)
    try:
        piped = PipedFile(path)
    finally:
        os.umask(before)
    with piped:
        pass
    assert piped.join(LIMIT_S)
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_file_that_is_deleted_is_an_error(tmp_path: Path) -> None:
    piped = PipedFile(tmp_path / "file")
    with piped as path, path.open("wb", buffering=0) as writer:
        writer.write(b"before")
        while not (tmp_path / "file").read_bytes():
            time.sleep(0.001)
        (tmp_path / "file").unlink()
        writer.write(b"after")
    assert piped.join(LIMIT_S)
    assert piped.error is not None
    assert piped.error.strerror == "it was deleted while it was written"
