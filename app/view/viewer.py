"""Viewers as processes and peers: how they are started, found and disconnected."""

import contextlib
import errno
import logging
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
from importlib import metadata
from ipaddress import ip_address
from pathlib import Path

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig, ViewMode

logger = logging.getLogger(__name__)

#: Longest wait for a file to be completed, seconds: when the user interrupts, and otherwise.
FILE_CLOSE_S, FILE_PATIENCE_S = 1.2, 15.0
#: Longest wait for a peer's TCP handshake.
PROBE_TIMEOUT_S = 0.5
#: Versions of Rerun: the oldest that will do, as in pyproject.toml, and the newest that was tested.
_OLDEST_RERUN, _TESTED_RERUN = (0, 41), (0, 41)
_INSTALL = f"pip install 'rerun-sdk>={_OLDEST_RERUN[0]}.{_OLDEST_RERUN[1]}"


def check_rerun() -> None:
    """Raise ViewError if Rerun is not installed, or too old."""
    found, version = _installed_rerun()
    if found < _OLDEST_RERUN:
        wanted = _INSTALL.partition(">=")[2]
        raise ViewError(f"{version}; to show or save results, {wanted} or newer is needed: {_INSTALL}'")


def untested_rerun() -> str:
    """Return how an error ends, with what to do, if Rerun is newer than any that was tested."""
    found, version = _installed_rerun()
    if found <= _TESTED_RERUN:
        return ""
    major, minor = _TESTED_RERUN
    tested = f"the newest that was tested is {major}.{minor}"
    return f"; {version}, which may not fit: {tested}: {_INSTALL},<{major}.{minor + 1}'"


def _installed_rerun() -> tuple[tuple[int, int], str]:
    """Return the version's first two numbers, and a sentence that names it."""
    try:
        version = metadata.version("rerun-sdk")
    except metadata.PackageNotFoundError:
        return (0, 0), "rerun-sdk is not installed"
    numbers = re.match(r"(\d+)\.(\d+)", version)
    return (int(numbers[1]), int(numbers[2])) if numbers else (0, 0), f"rerun-sdk {version} is installed"


def chosen_mode(config: ViewConfig, *, interactive: bool = False) -> ViewMode:
    """Return where to show; "auto" depends on the display and on whether a user waits at a terminal."""
    if config.mode != "auto":
        return config.mode
    if config.connect is not None:
        return "connect"
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return "spawn"
    return "serve" if interactive else "none"


def viewer_executable() -> Path:
    """Return the native viewer of the package; the ``rerun`` script is a Python wrapper around it."""
    import rerun_cli  # type: ignore[import-untyped]

    path = Path(rerun_cli.__file__).parent / "rerun"
    if not path.is_file():
        raise ViewError(f"{path}: Rerun's viewer is missing; reinstall the package rerun-sdk")
    return path


def viewer_command(recording: str | Path) -> str:
    """Return what opens a recording from this folder's terminal, also where no environment is active."""
    script = Path(sys.executable).with_name("rerun")
    if not script.exists() or shutil.which("rerun") == str(script):
        return shlex.join(["rerun", str(recording)])
    if script.is_relative_to(Path.cwd()):
        script = script.relative_to(Path.cwd())
    return shlex.join([str(script), str(recording)])


def start_viewer(
    config: ViewConfig, port: int, *words: str, detached: bool = True
) -> subprocess.Popen[bytes]:
    """Start Rerun's viewer, with further arguments; it listens on `port` of `config.bind` only.

    It outlives this process or, if it is not `detached`, ends with the thread that started it.
    """
    from nurbseg.common.process.child import with_parent_death_signal

    memory = config.memory_limit
    command = [
        str(viewer_executable()),
        *("--bind", config.bind, "--port", str(port)),
        *("--memory-limit", memory, "--server-memory-limit", "64MB" if detached else memory),
        *("--expect-data-soon", *words),
    ]
    try:
        process = subprocess.Popen(
            command if detached else with_parent_death_signal(command),
            env=private_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # Not in this process's group, which gets the terminal's signals and is ended as a whole.
            start_new_session=detached,
        )
    except OSError as err:
        raise ViewError(f"{command[0]}: cannot be started: {err}") from err
    with contextlib.suppress(OSError):
        # Drawing takes more than the core that this process may be kept on.
        os.sched_setaffinity(process.pid, os.sched_getaffinity(os.getppid()))
    return process


def start_web_server(config: ViewConfig, port: int, web_port: int) -> subprocess.Popen[bytes]:
    """Start a process that serves the viewer as a web page, and ends with the thread that started it."""
    return start_viewer(config, port, "--serve-web", "--web-viewer-port", str(web_port), detached=False)


def private_environment() -> dict[str, str]:
    """Return an environment in which Rerun collects no usage statistics.

    Rerun 0.41 has no setting for a single run, but sends nothing where the variable CI is set. ``rerun
    analytics disable`` would be permanent and affect all of the user's programs.
    """
    from nurbseg.common.process.child import environment

    kept = {name: value for name, value in environment().items() if name != "FORCE_RERUN_ANALYTICS"}
    return kept | {"CI": "true"}


def free_port(bind: str) -> int:
    """Return a free TCP port; raises ViewError if that fails."""
    try:
        return _bound(bind, 0)
    except OSError as err:
        raise ViewError(f"bind {bind}: cannot listen there: {err.strerror}") from err


def is_taken(bind: str, port: int) -> bool:
    """Whether a port is in use; raises ViewError if nothing can listen there for another reason."""
    try:
        _bound(bind, port)
    except OSError as err:
        if err.errno == errno.EADDRINUSE:
            return True
        raise ViewError(f"bind {bind}, port {port}: cannot listen there: {err.strerror}") from err
    return False


def _bound(bind: str, port: int) -> int:
    """Bind a port briefly; return its number."""
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    with socket.socket(family) as probe:
        if port:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((bind, port))
        number: int = probe.getsockname()[1]
        return number


def reachable(bind: str) -> str:
    """Return an address at which a server bound to `bind` can be reached."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(bind, bind)


def warn_beyond_loopback(bind: str, *ports: int, lacks: str = "password or encryption") -> None:
    """Warn if other computers can connect and so see the camera's images, and name what the stream lacks."""
    if not ip_address(bind).is_loopback:
        logger.warning(
            "anyone who can reach %s, ports %s, sees what the camera sees: the stream has no %s",
            bind,
            " and ".join(map(str, ports)),
            lacks,
        )


def listens(host: str, port: int) -> bool:
    """Whether a peer accepts connections, within `PROBE_TIMEOUT_S`.

    Without a listener, Rerun's own connection attempt blocks for seconds, and logging then forever.
    """
    try:
        with socket.create_connection((host, port), timeout=PROBE_TIMEOUT_S):
            return True
    except OSError:
        return False
