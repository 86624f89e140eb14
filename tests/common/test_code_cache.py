from __future__ import annotations

import os
from pathlib import Path

import pytest

from nurbseg.common import code_cache
from nurbseg.common.code_cache import UnusableFolderError, private_folder


def test_a_folder_is_created_for_this_user_alone(tmp_path: Path) -> None:
    umask = os.umask(0)
    try:
        folder = private_folder(tmp_path / "a/nurbseg")
    finally:
        os.umask(umask)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert private_folder(folder) == folder


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770, 0o750, 0o705])
def test_nothing_is_cached_where_others_can_enter(tmp_path: Path, mode: int) -> None:
    folder = private_folder(tmp_path / "nurbseg")
    folder.chmod(mode)
    with pytest.raises(UnusableFolderError, match=f"^{folder}: other users can enter it"):
        private_folder(folder)
    folder.chmod(0o700)
    private_folder(folder)


def test_nothing_is_cached_in_what_belongs_to_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = private_folder(tmp_path / "nurbseg")
    own = os.geteuid()
    monkeypatch.setattr("os.geteuid", lambda: own + 1000)
    with pytest.raises(UnusableFolderError, match=f"^{folder}: belongs to another user"):
        private_folder(folder)


def test_nothing_is_cached_in_a_link_or_what_is_no_folder(tmp_path: Path) -> None:
    folder = private_folder(tmp_path / "nurbseg")
    (tmp_path / "link").symlink_to(folder)
    with pytest.raises(UnusableFolderError, match="link: is a link"):
        private_folder(tmp_path / "link")
    (tmp_path / "file").touch()
    with pytest.raises(UnusableFolderError, match="file: File exists"):
        private_folder(tmp_path / "file")
    with pytest.raises(UnusableFolderError, match=r"^/proc/nowhere: No such file or directory$"):
        private_folder(Path("/proc/nowhere"))


@pytest.mark.parametrize("named", ["", ".", "cache", "./cache"])
def test_the_working_folder_is_nobodys_cache(
    named: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    monkeypatch.setattr(code_cache, "_folder", code_cache._folder.__wrapped__)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    folder, _ = code_cache.code_cache()
    assert folder is not None and folder.parent == tmp_path / "home/.cache/nurbseg"
    monkeypatch.setenv("HOME", ".")
    assert "HOME is not an absolute path" in code_cache.cache_error()
