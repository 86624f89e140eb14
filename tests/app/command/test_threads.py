import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from nurbseg.app.live.progress import Progress
from nurbseg.common.computer import leave_a_core, limit_blas_threads

ROOT = Path(__file__).parents[3]
_CHILD = """
import os, sys
from nurbseg.{module} import main
assert "numpy" not in sys.modules, "the number of threads must be set before numpy is imported"
try:
    main({words})
except SystemExit:
    pass
print(os.environ.get("OPENBLAS_NUM_THREADS"))
"""


def test_a_number_that_the_user_has_set_counts():
    environment = {"OMP_NUM_THREADS": "2"}
    limit_blas_threads(environment)
    assert environment == {"OMP_NUM_THREADS": "2"}


def test_the_commands_ask_for_one_thread_before_numpy_is_imported():
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    for module, words in (
        ("app.command.live_command", ["--print-config"]),
        ("evaluation.eval_command", ["--help"]),
    ):
        run = subprocess.run(
            [sys.executable, "-c", _CHILD.format(module=module, words=words)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        assert run.stdout.splitlines()[-1] == "1", module


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_a_thread_and_those_that_it_starts_keep_off_one_core():
    cores = os.sched_getaffinity(0)
    seen = []

    def note():
        seen.append(os.sched_getaffinity(0))

    def leave():
        leave_a_core([threading.current_thread()])
        note()
        started = threading.Thread(target=note)
        started.start()
        started.join()

    thread = threading.Thread(target=leave)
    thread.start()
    thread.join()
    assert seen == [cores - {max(cores)}] * 2
    assert os.sched_getaffinity(0) == cores


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_threads_that_have_ended_do_not_keep_others_from_leaving_a_core():
    ended = threading.Thread(target=int)
    ended.start()
    ended.join()
    waiting = threading.Event()
    thread = threading.Thread(target=waiting.wait, args=(10.0,))
    thread.start()
    leave_a_core([threading.Thread(), ended, thread])
    cores = os.sched_getaffinity(0)
    left = os.sched_getaffinity(thread.native_id)
    waiting.set()
    thread.join()
    assert left == cores - {max(cores)}


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_one_core_is_enough():
    program = (
        "import os, threading\n"
        "from nurbseg.common.computer import leave_a_core\n"
        "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "leave_a_core([threading.current_thread()])\n"
        "print(len(os.sched_getaffinity(0)))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert run.stdout == "1\n"


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_in_a_live_run_only_the_thread_that_segments_uses_all_cores(tmp_path: Path):
    words = ["--replay", "recordings/demo.mcap", "--loop", "--duration", "300", "--control", "off"]
    words += ["--view", "none", "--save", str(tmp_path / "a.rrd")]
    command = [Path(sys.executable).with_name("nurbseg-live"), *words]
    log = tmp_path / "log"
    with log.open("wb") as file:
        run = subprocess.Popen(command, cwd=ROOT, stderr=file)
    cores = os.sched_getaffinity(0)
    try:
        end_s = time.monotonic() + 240.0
        while time.monotonic() < end_s and run.poll() is None:
            masks = affinities(run.pid)
            if len(masks) >= 5 and all(
                mask == (cores if thread == run.pid else cores - {max(cores)})
                for thread, mask in masks.items()
            ):
                break
            time.sleep(0.2)
        else:
            pytest.fail(f"threads of {run.pid} with their cores: {masks}; {log.read_text()}")
    finally:
        run.kill()
        run.wait(30.0)


def affinities(pid):
    """Return the cores of each thread of a process, and of the first of each that it started."""
    process, found = psutil.Process(pid), {}
    children = [each.pid for each in process.children(recursive=True)]
    for thread in (*(each.id for each in process.threads()), *children):
        try:
            found[thread] = os.sched_getaffinity(thread)
        except ProcessLookupError:
            continue
    return found


def test_the_threads_of_a_run_are_those_that_are_documented(live, tmp_path: Path, monkeypatch):
    page = (ROOT / "docs" / "architecture.md").read_text()
    row = page.partition("| `nurbseg-live` |")[2].partition("\n")[0]
    seen: set[str] = set()
    segmented = Progress.segmented

    def look(*arguments, **others):
        seen.update(thread.name for thread in threading.enumerate())
        return segmented(*arguments, **others)

    before = {thread.name for thread in threading.enumerate()} - {"MainThread"}
    monkeypatch.setattr(Progress, "segmented", look)
    run = live("--replay", str(ROOT / "recordings" / "demo.mcap"), "--frames", "8", "--view", "none",
               "--save", "a.rrd", "--record", "a.mcap", "--speed", "1")  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert seen - before == set(re.findall(r"`([A-Za-z-]+)`", row)) - {"warm-up"}
