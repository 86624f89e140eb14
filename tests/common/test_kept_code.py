from __future__ import annotations

import os
from pathlib import Path

import pytest

from nurbseg.common import kept_code
from nurbseg.common.kept_code import UnusableFolderError, code_folder, user_cache


@pytest.fixture
def above(tmp_path: Path) -> Path:
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o755)
    return folder


def test_folders_are_created_for_this_user_alone(tmp_path: Path) -> None:
    umask = os.umask(0)
    try:
        folder = code_folder(tmp_path / "a/cache", "nurbseg", "code")
    finally:
        os.umask(umask)
    assert folder == tmp_path / "a/cache/nurbseg/code"
    for parent in (folder, *folder.parents[:3]):
        assert parent.stat().st_mode & 0o777 == 0o700, parent
    assert code_folder(tmp_path / "a/cache", "nurbseg", "code") == folder


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770, 0o722])
@pytest.mark.parametrize(
    "place", ["", "nurbseg", "nurbseg/code", "nurbseg/code/file", "nurbseg/code/part/file"]
)
def test_nothing_is_kept_where_others_can_write(above: Path, place: str, mode: int) -> None:
    code_folder(above, "nurbseg", "code").chmod(0o755)
    path = above / place
    path.parent.mkdir(exist_ok=True)
    if path.name == "file":
        path.touch()
    path.chmod(mode)
    with pytest.raises(UnusableFolderError, match=f"^{path}: other users can write it"):
        code_folder(above, "nurbseg", "code")
    path.chmod(0o755)
    code_folder(above, "nurbseg", "code")


def test_further_up_others_may_write_only_where_they_cannot_replace(above: Path) -> None:
    higher = above.parent
    higher.chmod(0o777)
    with pytest.raises(UnusableFolderError, match=f"^{higher}: other users can write it"):
        code_folder(above, "code")
    higher.chmod(0o1777)
    if os.geteuid():
        higher.chmod(0o755)  # only a folder of the system is trusted to stay so
    code_folder(above, "code")


@pytest.mark.parametrize("place", ["", "code", "code/file"])
def test_nothing_is_kept_in_what_belongs_to_another_user(
    above: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code_folder(above, "code") / "file").touch()
    own, lstat = os.geteuid(), Path.lstat
    stranger = above / place

    def owned_by_somebody(path: Path) -> os.stat_result:
        status = lstat(path)
        owner = own + 1000 if path == stranger else status.st_uid
        return os.stat_result((*status[:4], owner, *status[5:10]))

    monkeypatch.setattr(Path, "lstat", owned_by_somebody)
    with pytest.raises(UnusableFolderError, match=f"^{stranger}: belongs to another user"):
        code_folder(above, "code")


def test_links_in_the_folder_are_not_followed_and_one_above_is_resolved_once(above: Path) -> None:
    folder = code_folder(above, "code")
    link = above.parent / "link"
    link.symlink_to(above)
    assert code_folder(link, "code") == folder
    (folder / "file").symlink_to("/etc/hostname")
    with pytest.raises(UnusableFolderError, match=r"code/file: is a link"):
        code_folder(above, "code")
    (above / "other").symlink_to(folder)
    with pytest.raises(UnusableFolderError, match=r"other: is a link"):
        code_folder(above, "other")
    link.unlink()
    link.symlink_to(link)
    with pytest.raises(UnusableFolderError, match="link"):
        code_folder(link, "code")


def test_modes_within_a_folder_that_only_this_user_enters_do_not_matter(above: Path) -> None:
    folder = code_folder(above, "code")
    (folder / "file").touch()
    (folder / "file").chmod(0o666)
    assert code_folder(above, "code") == folder


def test_a_group_of_this_user_alone_may_write(above: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    above.chmod(0o775)
    monkeypatch.setattr(kept_code, "_is_own_group", lambda group: group == above.stat().st_gid)
    code_folder(above, "code")


@pytest.mark.parametrize("named", ["", ".", "cache", "./cache"])
def test_the_working_folder_is_nobodys_cache(named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert user_cache() == Path("/home/somebody/.cache")
    monkeypatch.setenv("HOME", ".")
    with pytest.raises(UnusableFolderError, match="HOME is not an absolute path"):
        user_cache()


def test_a_folder_that_cannot_be_created_is_named() -> None:
    with pytest.raises(UnusableFolderError, match=r"^/proc/nowhere: No such file or directory$"):
        code_folder(Path("/proc/nowhere"), "code")
