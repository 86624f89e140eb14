"""A Rerun that does not fit is named when a run starts, with what to install."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view import viewer
from nurbseg.app.view.opening import begin_view

ROOT = Path(__file__).parents[3]
_RUN = (
    "--quiet",
    "--replay",
    str(ROOT / "recordings/demo.mcap"),
    "--frames",
    "1",
    "--speed",
    "0",
    "--view",
    "none",
)


def pretend(folder: Path, version: str) -> dict[str, str]:
    """Return an environment in which another version of Rerun seems to be installed."""
    about = folder / f"rerun_sdk-{version}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: rerun-sdk\nVersion: {version}\n")
    return {**os.environ, "PYTHONPATH": str(folder)}


def live(environment: dict[str, str], folder: Path) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).with_name("nurbseg-live")), *_RUN, "--save", "run.rrd"]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=200)


def test_a_rerun_that_is_too_old_is_refused_at_once(tmp_path: Path) -> None:
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (oldest,) = (each.removeprefix("rerun-sdk>=") for each in wanted if each.startswith("rerun-sdk"))
    done = live(pretend(tmp_path, "0.40.2"), tmp_path)
    assert done.returncode == 2
    assert done.stderr == (
        f"nurbseg-live: error: rerun-sdk 0.40.2 is installed; to show or save results, {oldest} or newer is "
        f"needed: pip install 'rerun-sdk>={oldest}'\n"
    )
    assert not (tmp_path / "run.rrd").exists()


def test_a_rerun_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise viewer.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(viewer.metadata, "version", missing)
    with pytest.raises(ViewError, match=r"^rerun-sdk is not installed; .* pip install 'rerun-sdk>=0.41'$"):
        begin_view(ViewConfig(mode="serve"))
    assert begin_view(ViewConfig(mode="none")) is None


def test_a_newer_rerun_is_used_where_it_fits(tmp_path: Path) -> None:
    done = live(pretend(tmp_path, "0.99.0"), tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "run.rrd").stat().st_size > 0


def test_a_newer_rerun_that_lacks_something_is_named_with_what_to_install(tmp_path: Path) -> None:
    environment = pretend(tmp_path, "0.99.0")
    pinned = re.search(r"^rerun-sdk==(\d+)\.(\d+)", (ROOT / "requirements/dev.txt").read_text(), re.MULTILINE)
    assert pinned is not None
    major, minor = pinned.groups()
    (tmp_path / "rerun.py").write_text("")
    done = live(environment, tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith(
        f"; rerun-sdk 0.99.0 is installed, which may not fit: the newest that was tested is {major}.{minor}: "
        f"pip install 'rerun-sdk>=0.41,<{major}.{int(minor) + 1}'"
    )
