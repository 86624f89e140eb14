"""Standard streams that are closed, full or not read, and pipes as files: no traceback, nothing replaced."""

import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rendered import rendered
from waiting import wait_until

COMMANDS = Path(sys.executable).parent
DEMO = Path(__file__).parents[2] / "recordings" / "demo.mcap"
#: Commands that print a lot, a little, and what `argparse` does not print itself.
PRINTING = [
    f"nurbseg-record check {DEMO}",
    f"nurbseg-eval noise {DEMO} --frames 1",
    "nurbseg-devices --json",
    "nurbseg-live --print-config",
]
_LIVE = f"nurbseg-live --replay {DEMO} --frames 1 --speed 0 --view none --splits-max 1 --decimation 8"
#: Commands that write a file, with its first bytes.
WRITING = [
    (f"{_LIVE} --report", "out.json", b'{\n "ended": "the source ended"'),
    (f"{_LIVE} --force --save", "out.rrd", b"RRF2"),
    (f"{_LIVE} --record", "out.mcap", b"\x89MCAP"),
    (f"nurbseg-record repair {DEMO} --out", "out.mcap", b"\x89MCAP"),
    (f"nurbseg-record convert --to 0.1 --force {DEMO}", "out.mcap", b"\x89MCAP"),
]


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of bash, which has the redirections that the tests are about."""
    return subprocess.run(
        ["bash", "-c", f"PATH={COMMANDS}:$PATH; {line}"],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize("command", PRINTING)
def test_a_reader_that_has_ended_is_no_error_message(command: str, tmp_path: Path) -> None:
    done = shell(f"{command} | true; exit ${{PIPESTATUS[0]}}", tmp_path)
    assert done.stderr == ""
    assert done.returncode in (0, 1)


@pytest.mark.parametrize("command", PRINTING)
def test_a_full_disk_under_standard_output_is_named(command: str, tmp_path: Path) -> None:
    done = shell(f"{command} > /dev/full", tmp_path)
    name = command.partition(" ")[0]
    assert done.stderr == f"{name}: error: standard output: No space left on device\n"
    assert done.returncode == 1


@pytest.mark.parametrize("command", PRINTING)
def test_closed_standard_output_is_no_output(command: str, tmp_path: Path) -> None:
    as_usual = shell(f"{command} > /dev/null", tmp_path)
    closed = shell(f"{command} >&-", tmp_path)
    assert (closed.returncode, closed.stderr) == (as_usual.returncode, as_usual.stderr)


def test_a_run_without_standard_streams_writes_its_files_and_nothing_else_into_them(tmp_path: Path) -> None:
    done = shell(f"{_LIVE} --record a.mcap <&- >&- 2>&-", tmp_path)
    assert done.returncode == 0
    checked = shell("nurbseg-record check a.mcap", tmp_path)
    assert "a.mcap: whole, 1 frame" in checked.stdout, checked


@pytest.mark.parametrize(("command", "name", "head"), WRITING)
def test_a_file_that_is_a_pipe_gets_what_is_written_and_stays(
    command: str, name: str, head: bytes, tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / name)
    done = shell(f"timeout 60 cat {name} > got & {command} {name} && wait $!", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / name).is_fifo()
    assert (tmp_path / "got").read_bytes().startswith(head)


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
@pytest.mark.parametrize("number", [None, signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_pipe_that_nobody_reads_stops_neither_the_run_nor_its_end(
    stream: str, number: signal.Signals | None, tmp_path: Path
) -> None:
    unread, full = os.pipe()
    fcntl.fcntl(full, fcntl.F_SETPIPE_SZ, 4096)
    os.write(full, bytes(4096))
    words = f"{_LIVE} --publish jsonl --speed 1 --frames 5 --export out --verbose".split()
    words += [] if number is None else ["--loop", "--frames", "100000"]
    streams = {name: subprocess.DEVNULL for name in ("stdin", "stdout", "stderr")} | {stream: full}
    with subprocess.Popen(
        [COMMANDS / words[0], *words[1:]], cwd=tmp_path, **{**streams, stream: full}
    ) as run:
        try:
            if number is not None:
                wait_until(lambda: len(list(tmp_path.glob("out/*_tree.json"))) > 4, "5 frames are exported")
                run.send_signal(number)
            assert run.wait(60.0) == (0 if number is None else 128 + number)
        finally:
            run.kill()
            os.close(unread)
            os.close(full)
    assert list(tmp_path.glob("out/*_tree.json"))


def test_a_full_disk_under_the_files_of_a_study_is_named(tmp_path: Path) -> None:
    command = f"nurbseg-eval run {rendered('width=96&height=72&frames=1')} --methods fh04 --time-frames 0"
    command += " --no-report --out s"
    assert shell(command, tmp_path).returncode == 0
    whole = sorted(path.name for path in (tmp_path / "s").iterdir())
    table = (tmp_path / "s" / "results.csv").read_bytes()
    done = shell(f"ulimit -f 1; {command}", tmp_path)
    assert done.returncode == 1
    assert "nurbseg-eval: error: s/results.parquet: File too large" in done.stderr
    assert sorted(path.name for path in (tmp_path / "s").iterdir()) == whole
    assert (tmp_path / "s" / "results.csv").read_bytes() == table
