"""How programs are started: without the current folder's modules, and not outliving who starts them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from nurbseg.common.process.child import environment, python_command, with_parent_death_signal

_STARTS = """
import subprocess, sys, time
from nurbseg.common.process.child import with_parent_death_signal
program = subprocess.Popen(with_parent_death_signal(["/bin/sleep", "300"]))
print(program.pid, flush=True)
time.sleep(300)
"""


def test_a_program_dies_with_the_one_that_starts_it() -> None:
    with subprocess.Popen([sys.executable, "-c", _STARTS], stdout=subprocess.PIPE, text=True) as starts:
        assert starts.stdout is not None
        sleeps = psutil.Process(int(starts.stdout.readline()))
        assert sleeps.is_running()
        starts.kill()
        sleeps.wait(30.0)


def test_it_is_the_program_itself_with_its_arguments_and_exit_code() -> None:
    words = [sys.executable, "-c", "import sys; print(sys.argv[1:]); sys.exit(7)", "a b", "$HOME"]
    done = subprocess.run(with_parent_death_signal(words), capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (7, "['a b', '$HOME']\n")


def test_a_module_of_the_current_folder_is_not_run(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("raise SystemExit(9)")
    done = subprocess.run(
        python_command("json.tool", "--help"), cwd=tmp_path, timeout=60, capture_output=True
    )
    assert done.returncode == 0


@pytest.mark.parametrize("name", ["PATH", "PYTHONPATH", "LD_LIBRARY_PATH"])
def test_no_program_looks_for_code_in_the_working_folder(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for given, expected in (
        ("/a:/b", "/a:/b"),
        (":/a::/b:", "/a:/b"),
        (".:/a:bin:./lib", "/a"),
        ("", None),
        (":", None),
    ):
        monkeypatch.setenv(name, given)
        assert environment().get(name) == expected
    monkeypatch.delenv(name)
    assert name not in environment()
