"""What is silent for too long is ended, however long it may take otherwise."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent.parent / ".ci" / "silence.py"


def run(limit_s: float, program: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(PROGRAM), str(limit_s), sys.executable, "-u", "-c", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_what_prints_now_and_then_may_take_longer_than_the_limit() -> None:
    talkative = "import time\nfor n in range(8):\n    print(n)\n    time.sleep(0.5)\nraise SystemExit(3)"
    done = run(3.0, talkative)
    assert (done.returncode, done.stdout.split()) == (3, list("01234567"))


def test_what_has_ended_is_not_waited_for_where_its_output_is_held() -> None:
    sleep = "[sys.executable, '-c', 'import time; time.sleep(40)']"
    began_s = time.monotonic()
    done = run(50.0, f"import subprocess, sys\nprint(subprocess.Popen({sleep}).pid)")
    os.kill(int(done.stdout), signal.SIGKILL)
    assert done.returncode == 0
    assert time.monotonic() - began_s < 30


@pytest.mark.parametrize("catches", ["", "signal.signal(signal.SIGINT, signal.SIG_IGN)"])
def test_what_is_silent_is_ended_with_what_it_started(
    catches: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    quick = tmp_path / "silence.py"
    quick.write_text(PROGRAM.read_text().replace("_END_S = 30.0", "_END_S = 1.0"))
    monkeypatch.setattr(sys.modules[__name__], "PROGRAM", quick)
    alive = tmp_path / "alive"
    child = (
        f"import pathlib, time\nwhile True:\n    pathlib.Path({str(alive)!r}).touch()\n    time.sleep(0.1)"
    )
    silent = (
        f"import signal, subprocess, sys, time\n{catches}\nprint('begun')\n"
        f"subprocess.Popen([sys.executable, '-c', {child!r}])\ntime.sleep(50)"
    )
    began_s = time.monotonic()
    done = run(2.0, silent)
    assert done.returncode == 124
    assert done.stdout.startswith("begun\n")
    assert "no output for 2 s: ended" in done.stdout
    assert time.monotonic() - began_s < 40
    last = alive.stat().st_mtime
    time.sleep(0.5)
    assert alive.stat().st_mtime == last
