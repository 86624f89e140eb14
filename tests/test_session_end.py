"""A session of tests ends, with the right exit code, whatever its tests leave behind."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

_LEAVES_A_THREAD = """
import threading

def test_it():
    threading.Thread(target=threading.Event().wait, name="stuck", daemon={daemon}).start()
    assert {passes}
"""


@pytest.mark.parametrize("processes", [0, 2])
@pytest.mark.parametrize("daemon", [True, False])
@pytest.mark.parametrize(("passes", "code"), [(True, 0), (False, 1)])
def test_a_stuck_thread_keeps_no_session_from_ending(
    tmp_path: Path, processes: int, daemon: bool, passes: bool, code: int
) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_it.py").write_text(_LEAVES_A_THREAD.format(daemon=daemon, passes=passes))
    done = subprocess.run(
        [
            *[sys.executable, "-m", "pytest", "-q", "-p", "xdist.plugin", "-p", "session_end"],
            *["-p", "no:cacheprovider", "-n", str(processes)],
        ],
        cwd=tmp_path,
        # Loading all plugins that are installed would take longer than the rest.
        env=os.environ
        | {"PYTHONPATH": str(Path(__file__).parent / "fakes"), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert ("1 passed" if passes else "1 failed") in done.stdout
    by_force = "ended by force, threads still run: stuck" in done.stdout.splitlines()
    assert by_force == (not daemon and not processes)
