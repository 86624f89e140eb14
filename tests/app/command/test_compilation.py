from __future__ import annotations

import gc
import importlib.util
import logging
import os
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from child_python import run_python
from numba.core import event

from nurbseg.app.command import compilation
from nurbseg.app.command.compilation import logged_compilation
from nurbseg.common.process import child

_MODULE = """
from nurbseg.common.compiled import compiled

@compiled
def total(count):
    found = 0
    for each in range(count):
        found += each
    return found
"""


@pytest.fixture(autouse=True)
def _code_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))


def _loaded(folder: Path) -> ModuleType:
    (folder / "loops.py").write_text(_MODULE)
    spec = importlib.util.spec_from_file_location("loops", folder / "loops.py")
    assert spec is not None and spec.loader is not None
    loops = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loops)
    return loops


def test_compiling_is_reported_once_and_how_long_it_took(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loops = _loaded(tmp_path)
    with caplog.at_level(logging.INFO, "nurbseg"), logged_compilation():
        assert loops.total(5) == 10
        assert loops.total(5.0 > 1.0) == 0  # another type, compiled anew
    said = [record.getMessage() for record in caplog.records]
    assert [text.split(";")[0] for text in said] == ["compiling the inner loops", said[1].split(";")[0]]
    assert said[1].startswith("compiling took")


def test_code_that_cannot_be_kept_is_said_to_be_compiled_in_every_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = "from nurbseg.common.code_cache import cache_error; print(cache_error())"
    folders = (str(tmp_path), "/proc/nowhere")
    kept = [run_python(script, environment={"NUMBA_CACHE_DIR": folder}).stdout.strip() for folder in folders]
    assert kept == ["", "/proc/nowhere: No such file or directory"]
    monkeypatch.setattr(compilation, "cache_error", lambda: "the disk is full")
    with caplog.at_level(logging.INFO, "nurbseg"), logged_compilation():
        _loaded(tmp_path).total(5)
    assert "in every run: to keep the code, set XDG_CACHE_HOME" in caplog.messages[0]
    assert "the disk is full" in caplog.messages[0]
    assert "later runs" not in caplog.messages[-1]


def test_progress_is_reported_from_time_to_time(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    loops = _loaded(tmp_path)
    with caplog.at_level(logging.INFO, "nurbseg"), logged_compilation():
        loops.total(5)
        monkeypatch.setattr(compilation, "_PROGRESS_S", 0.0)
        for value in (np.int8(3), np.int16(3)):
            loops.total(value)
    said = [record.getMessage() for record in caplog.records if "done" in record.getMessage()]
    assert said == ["compiling: 2 functions done", "compiling: 3 functions done"]


def test_garbage_is_searched_for_less_often_while_code_is_compiled(tmp_path: Path) -> None:
    loops, thresholds, during = _loaded(tmp_path), gc.get_threshold(), []

    class Spy(event.Listener):
        def on_start(self, event: event.Event) -> None:
            during.append(gc.get_threshold())

        def on_end(self, event: event.Event) -> None:
            pass

    with logged_compilation(), event.install_listener("numba:compile", Spy()):
        loops.total(5)
        assert gc.get_threshold() == thresholds
    assert [threshold[0] for threshold in during] == [100_000]


def test_compilation_in_the_background_ends_with_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = "import os, sys, time; os.symlink(str(os.getpid()), sys.argv[1]); time.sleep(60)"
    command = [sys.executable, "-c", script, str(tmp_path / "process")]
    monkeypatch.setattr(child, "python_command", lambda _: command)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    loops = _loaded(tmp_path)
    with logged_compilation():
        loops.total(5)
        deadline_s = time.monotonic() + 30.0
        while not os.path.lexists(tmp_path / "process") and time.monotonic() < deadline_s:
            time.sleep(0.05)
    process = int(str((tmp_path / "process").readlink()))
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_cached_functions_are_not_reported(tmp_path: Path) -> None:
    (tmp_path / "loops.py").write_text(_MODULE)
    script = (
        "import logging, sys\n"
        "logging.basicConfig(level=logging.INFO)\n"
        "from nurbseg.app.command.compilation import logged_compilation\n"
        "import loops\n"
        "with logged_compilation():\n"
        "    print(loops.total(5))\n"
    )
    runs = [run_python(script, cwd=tmp_path) for _ in range(2)]
    assert [run.stdout.strip() for run in runs] == ["10", "10"]
    assert "compiling" in runs[0].stderr
    assert "compiling" not in runs[1].stderr


def test_no_process_is_started_once_the_run_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that warms up may still compile then."""
    started: list[object] = []
    monkeypatch.setattr(compilation.subprocess, "Popen", lambda *words, **options: started.append(words))
    monkeypatch.setattr(compilation.os, "cpu_count", lambda: 2)
    listener = compilation._Listener()
    listener.end()
    listener.on_start(event.Event("numba:compile", event.EventStatus.START))
    assert not started
