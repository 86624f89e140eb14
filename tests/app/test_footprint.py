"""What each kind of run touches, watched from outside, is what docs/reliability.md says."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest
from recorded_scene import scenes, write_mcap
from rendered import rendered
from virtual_camera import VirtualCameras, openni2_redist, virtual_cameras

from nurbseg import app, drivers, segmentation
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.viewer import free_port, start_web_server

__all__ = ["openni2_redist", "virtual_cameras"]

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
FAST = ("--splits-max", "1", "--decimation", "8")
SCENE = rendered("width=96&height=72&frames=4")
LOCAL = ("127.0.0.1", "::1")
#: Variables that compiled code of libraries reads, which leaves no trace between ours and the reading.
_COMPILED = ("PYARROW_IGNORE_TIMEZONE",)

#: What Python's `platform` and `ctypes.util` run for a moment to ask about the computer.
_OF_PYTHON = {"uname", "ldconfig", "ldconfig.real", "gcc", "ld", "objdump", "sh", "dash"}
#: Where our own files are.
_OURS = tuple(f"{folder}/" for package in (app, drivers, segmentation) for folder in package.__path__)
#: Runs in each process before anything else: notes which variables our own files read, and what it starts.
_WATCHER = """\
import os, sys
_get = os._Environ.__getitem__
def _noting(self, name):
    frame, chain = sys._getframe(1), []
    while frame is not None and frame.f_code.co_filename.rpartition("/")[2] in ("os.py", "<frozen os>",
                                                                               "<frozen _collections_abc>"):
        chain.append(frame.f_code.co_name)
        frame = frame.f_back
    # Copies of the whole environment, for other programs, read nothing.
    if frame is not None and frame.f_code.co_filename.startswith({ours!r}) and not {{"items", "__iter__",
            "__or__", "copy", "keys", "setdefault"}} & {{*chain, frame.f_code.co_name}}:
        with open({said!r}, "a") as file:
            file.write(name + "\\n")
    return _get(self, name)
os._Environ.__getitem__ = _noting
def _starting(event, details):
    if event == "subprocess.Popen":
        with open({started!r}, "a") as file:
            print(*map(os.fsdecode, details[1]), file=file)
sys.addaudithook(_starting)
"""


def table(title: str) -> dict[str, list[str]]:
    """Return the rows of a table below a heading: the cells after the first, by what the first one names."""
    section = PAGE.read_text().partition(f"## {title}\n")[2].partition("\n## ")[0]
    assert section, title
    rows: dict[str, list[str]] = {}
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| `"):
            for name in re.findall(r"`([^`]+)`", cells[0]):
                rows[name] = cells[1:]
    return rows


RUNS = table("What a run touches")


@dataclass
class Seen:
    """What was seen of a program and those that it started."""

    programs: set[str] = field(default_factory=set)
    most: dict[str, int] = field(default_factory=dict)
    #: Address and port, and the program.
    listening: set[tuple[str, int, str]] = field(default_factory=set)
    connected: set[str] = field(default_factory=set)
    datagrams: set[tuple[str, int]] = field(default_factory=set)


def program_of(process: psutil.Process) -> str:
    """Return the module that a process runs, or the name of its program; nothing while it is starting."""
    return program_named(process.cmdline())


def program_named(words: list[str]) -> str:
    """Return what a command line runs: a module, or a program other than Python."""
    if "-m" in words:
        return words[words.index("-m") + 1]
    name = Path(words[0]).name if words else ""
    return "" if name.startswith("python") else name


class Watched:
    """A command while it runs."""

    def __init__(self, words: tuple[str, ...], folder: Path) -> None:
        environment = os.environ | {"PYTHONPATH": os.fspath(folder / "watcher")}
        (folder / "watcher").mkdir()
        self.said = folder / "variables"
        self.started = folder / "started"
        (folder / "watcher" / "sitecustomize.py").write_text(
            _WATCHER.format(said=str(self.said), started=str(self.started), ours=_OURS)
        )
        command = Path(sys.executable).with_name(words[0])
        self.seen = Seen()
        self.stderr = folder / "stderr"
        with self.stderr.open("w") as stderr:
            self.process = subprocess.Popen(
                [command, *words[1:]],
                cwd=folder,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                umask=0o022,
            )
        self._ended = threading.Event()
        self._watching = threading.Thread(target=self._watch)
        self._watching.start()

    def _watch(self) -> None:
        while not self._ended.wait(0.03):
            self.look()

    def look(self) -> None:
        try:
            own = psutil.Process(self.process.pid)
            children = own.children(recursive=True)
        except psutil.NoSuchProcess:
            return
        names: list[str] = []
        for child in (own, *children):
            try:
                name = "" if child is own else program_of(child)
                names += [name] if name else []
                connections = child.net_connections("inet")
            except psutil.Error:
                continue
            for connection in connections:
                if connection.type == 2:  # UDP
                    self.seen.datagrams.add(tuple(connection.laddr))
                elif connection.status == psutil.CONN_LISTEN:
                    self.seen.listening.add((*connection.laddr, name))
                elif connection.raddr:
                    self.seen.connected.add(connection.raddr.ip)
        self.seen.programs |= set(names)
        for name in set(names):
            self.seen.most[name] = max(self.seen.most.get(name, 0), names.count(name))

    def finish(self, until: Callable[[Seen], bool] | None = None) -> Seen:
        """Wait for its end, or interrupt it once something was seen; return what was."""
        deadline_s = time.monotonic() + 240.0
        while self.process.poll() is None and not (until is not None and until(self.seen)):
            assert time.monotonic() < deadline_s, self.stderr.read_text()
            time.sleep(0.05)
        if until is not None:
            assert self.process.poll() is None, self.stderr.read_text()
            self.process.send_signal(signal.SIGINT)
        code = self.process.wait(60.0)
        self.close()
        assert code in ((130,) if until is not None else (0, 1)), self.stderr.read_text()
        return self.seen

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._ended.set()
        self._watching.join()

    @property
    def programs(self) -> set[str]:
        """What was started, by its command line."""
        lines = self.started.read_text().splitlines() if self.started.exists() else []
        return {program_named(line.split()) for line in lines}

    @property
    def variables(self) -> set[str]:
        return set(self.said.read_text().split()) if self.said.exists() else set()


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[Callable[..., Watched]]:
    with ExitStack() as watched:
        yield lambda *words: watched.enter_context(closing(Watched(words, tmp_path)))


def assert_as_documented(run: str, watched: Watched) -> None:
    programs, listens, connects, *_ = RUNS[run]
    expected = set(re.findall(r"`([\w.]+)`", programs))
    # Some programs end before they are seen.
    assert (watched.seen.programs - _OF_PYTHON) | (watched.programs & expected) == expected
    ports = re.match(r"(\d) ports?", listens)
    assert {address for address, *_ in watched.seen.listening} <= set(LOCAL)
    # A program that runs for a moment may be missed while it listens.
    lasting = [each for each in watched.seen.listening if f"`{each[2]}` for a moment" not in programs]
    assert len(lasting) == (int(ports[1]) if ports else 0), watched.seen.listening
    assert watched.seen.connected <= (set(LOCAL) if connects != "nothing" else set())
    assert not watched.seen.datagrams
    documented = {*table("Environment variables"), *_COMPILED}
    assert watched.variables <= documented, watched.variables


LIVE = ("nurbseg-live", "--speed", "0", *FAST)


def test_every_run_in_the_table_is_watched() -> None:
    text = Path(__file__).read_text()
    assert RUNS
    for run in RUNS:
        assert text.count(f'assert_as_documented("{run}"') == 1, run


def test_a_replay(watch: Callable[..., Watched], tmp_path: Path) -> None:
    words = ("--export", "out", "--export-surfaces", "--report", "report.json", "--record", "a.mcap")
    watched = watch(*LIVE, "--replay", SCENE, "--view", "none", *words)
    watched.finish()
    assert_as_documented("live --view none", watched)
    modes = table("Files that are written")
    written = {path.name: path for path in tmp_path.rglob("*") if path.is_file()}
    for name, number in (("a.mcap", None), ("report.json", None), ("000000_labels.png", "labels")):
        row = next(key for key in modes if (number or name.partition(".")[2]) in key)
        assert f"{written[name].stat().st_mode & 0o777:04o}" in modes[row][0]


def test_a_saved_replay(watch: Callable[..., Watched], tmp_path: Path) -> None:
    watched = watch(*LIVE, "--replay", SCENE, "--view", "none", "--save", "a.rrd")
    watched.finish()
    assert_as_documented("live --save", watched)
    mode = next(cells[0] for key, cells in table("Files that are written").items() if "rrd" in key)
    assert f"{(tmp_path / 'a.rrd').stat().st_mode & 0o777:04o}" in mode


def test_a_served_page(watch: Callable[..., Watched]) -> None:
    watched = watch(
        "nurbseg-live",
        "--replay",
        SCENE,
        "--loop",
        "--view",
        "serve",
        "--port",
        "0",
        "--web-port",
        "0",
        *FAST,
    )
    watched.finish(until=lambda seen: len({each for each in seen.listening if "rerun" not in each}) >= 2)
    assert_as_documented("live --view serve", watched)


def test_a_viewer_elsewhere(watch: Callable[..., Watched]) -> None:
    port, web_port = free_port(LOCAL[0]), free_port(LOCAL[0])
    viewer = start_web_server(ViewConfig(), port, web_port)
    try:
        watched = watch("nurbseg-live", "--replay", SCENE, "--loop", "--connect", f"{LOCAL[0]}:{port}", *FAST)
        watched.finish(until=lambda seen: bool(seen.connected))
    finally:
        viewer.kill()
        viewer.wait()
    assert_as_documented("live --connect HOST", watched)


def test_a_camera(watch: Callable[..., Watched], virtual_cameras: VirtualCameras) -> None:
    virtual_cameras.add()
    watched = watch("nurbseg-live", "--device", "any", "--frames", "60", "--view", "none", *FAST)
    watched.finish()
    assert_as_documented("live --device any", watched)
    assert watched.seen.most["nurbseg.drivers.process.program"] == 1


def test_an_oni_recording(watch: Callable[..., Watched]) -> None:
    recording = Path(__file__).parents[1] / "fakes" / "camera.oni"
    watched = watch(*LIVE, "--replay", str(recording), "--view", "none")
    watched.finish()
    assert_as_documented("live --replay FILE.oni", watched)


def test_the_search_for_cameras(watch: Callable[..., Watched], virtual_cameras: VirtualCameras) -> None:
    virtual_cameras.add()
    watched = watch("nurbseg-devices", "list")
    watched.finish()
    assert_as_documented("devices list", watched)


def test_the_doctor(watch: Callable[..., Watched], virtual_cameras: VirtualCameras) -> None:
    virtual_cameras.add()
    watched = watch("nurbseg-devices", "doctor")
    watched.finish()
    assert_as_documented("devices doctor", watched)


def test_an_evaluation(watch: Callable[..., Watched]) -> None:
    watched = watch("nurbseg-eval", "run", SCENE, "--jobs", "2", "--methods", "stag15", "--out", "study")
    watched.finish()
    assert_as_documented("eval run --jobs 2", watched)


def test_a_check_of_a_recording(watch: Callable[..., Watched], tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(3))
    watched = watch("nurbseg-record", "check", str(path))
    watched.finish()
    assert_as_documented("record check", watched)
