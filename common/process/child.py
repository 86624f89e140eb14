"""Starts other programs, connects to our own, and ends them."""

import contextlib
import mmap
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from nurbseg.common.closing import Closing
from nurbseg.common.process.channel import Channel

#: A process that was killed ends within this time, seconds, unless the kernel waits for a dead disk.
_KILLED_S = 10.0
#: A process is not silent if its last heartbeat is not older than this, seconds.
_BEAT_S = 1.0
#: Asks Linux for the end of this process with that of its parent (PR_SET_PDEATHSIG), and becomes the program.
_BECOME = """\
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGKILL)
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""
#: Variables that list folders of code. An empty entry, or a relative one, is in the working folder.
_SEARCHED = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")


def environment() -> dict[str, str]:
    """Return the environment for another program, in which none looks for code in the working folder.

    Without this, importing OpenCV alone would make it do so: it adds an empty entry to `LD_LIBRARY_PATH`.
    """
    found = os.environ.copy()
    for name in _SEARCHED:
        folders = [word for word in found.pop(name, "").split(os.pathsep) if word.startswith("/")]
        if folders:
            found[name] = os.pathsep.join(folders)
    return found


def python_command(module: str, *words: str) -> list[str]:
    """Return the command that runs a module, such as ``nurbseg.app.view.program``, as a program of its own.

    With ``-P``, since Python would otherwise look for modules in the current folder first, and run any
    ``json.py`` found there.
    """
    return [sys.executable, "-P", "-m", module, *words]


def with_parent_death_signal(command: list[str]) -> list[str]:
    """Return a command that does the same, but is killed when the thread that starts it ends.

    For programs that do not watch their parent themselves.
    """
    return [sys.executable, "-I", "-S", "-c", _BECOME, str(os.getpid()), *command]


def exit_description(code: int | None) -> str:
    """Say how a process ended, of its exit code."""
    return f"ended by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"


def end_group(process: subprocess.Popen[bytes], limit_s: float) -> int | None:
    """Wait until a process that leads a session ends, or end it, with all that it started.

    Returns its exit code; None if it does not even end when it is killed.
    """
    if process.returncode is None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(limit_s)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_KILLED_S)
    return process.returncode


class ChildProcess(Closing):
    """Runs a module that begins with `nurbseg.common.process.channel.connect_to_parent`.

    `channel` is this end of the connection. What a `quiet` program writes to standard error is dropped.
    Raises OSError if it cannot be started.
    """

    def __init__(self, module: str, *, quiet: bool = True) -> None:
        with contextlib.ExitStack() as held:
            memory = os.memfd_create(module)
            held.callback(os.close, memory)
            os.ftruncate(memory, mmap.PAGESIZE)
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            held.callback(ours.close)
            with theirs:
                self._process = subprocess.Popen(
                    python_command(module, str(theirs.fileno()), str(memory)),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL if quiet else None,
                    env=environment(),
                    pass_fds=[theirs.fileno(), memory],
                    # Ctrl-C must reach this process only, which then ends the other.
                    start_new_session=True,
                )
            held.pop_all()
        self.channel = Channel(ours, memory)
        #: When it was looked at, and the processor time that it had used then; time that it had no core.
        self._looked, self._starved_s = (time.monotonic(), 0.0), 0.0

    def end(self, limit_s: float) -> int:
        """Wait until the process ends, or end it, with all that it started; return its exit code."""
        return end_group(self._process, limit_s) or 0

    def ending(self, limit_s: float) -> str:
        """Do what `end` does; return how the process ended, for a message."""
        return exit_description(self.end(limit_s))

    def hangs(self, limit_s: float) -> bool:
        """Whether it left no heartbeat for so long, although it had a core; to be called again and again."""
        now_s, silent_s = time.monotonic(), self.channel.silent_s
        try:
            words = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(") ")[2].split()
        except (OSError, IndexError):
            return silent_s > limit_s
        used_s = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        (before_s, used_before_s), self._looked = self._looked, (now_s, used_s)
        if silent_s < now_s - before_s or silent_s < _BEAT_S:
            self._starved_s = 0.0
        elif words[0] == "R":
            # It could run, but others did.
            self._starved_s += max(0.0, now_s - before_s - (used_s - used_before_s))
        return silent_s - self._starved_s > limit_s

    def close(self, limit_s: float = 0.0) -> None:
        """End the process and release what is shared with it; safe to call twice."""
        self.end(limit_s)
        self.channel.close()

    def peak_memory_mb(self) -> float:
        """Return the largest resident size that the process has had, 10^6 bytes; 0 where it is not known."""
        try:
            lines = Path(f"/proc/{self._process.pid}/status").read_text().splitlines()
        except OSError:
            return 0.0
        return sum(1024e-6 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
