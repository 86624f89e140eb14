from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
from rerun.experimental import ViewerClient

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.isolated import IsolatedView
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.viewer import free_port, listens, start_viewer, viewer_executable
from nurbseg.common.computer import leave_a_core
from nurbseg.library.result import FrameResult
from tests.fakes.fair_clock import FairClock
from tests.fakes.own_children import own_children
from tests.fakes.saved_view import read_saved_view
from tests.fakes.small_scene import CONFIG, numbered
from tests.fakes.waiting import wait_until

LOCAL = "127.0.0.1"
#: More than what sockets and queues on the way to a viewer can hold.
FRAMES = 150

_views: list[IsolatedView] = []


@pytest.fixture(autouse=True)
def views_are_closed() -> Iterator[None]:
    """Close what a test that failed left open: its threads would never end."""
    yield
    while _views:
        with suppress(ViewError):
            _views.pop().close()


@contextmanager
def stand_in(port: int, save: Path | None = None) -> Iterator[psutil.Process]:
    """Run the server part of the viewer, which needs no graphics; resumed and killed at the end."""
    words = ["--save", str(save)] if save is not None else ["--serve-grpc"]
    with subprocess.Popen(
        [viewer_executable(), *words, "--bind", LOCAL, "--port", str(port), "--server-memory-limit", "50MB"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            wait_until(lambda: listens(LOCAL, port), "the viewer listens")
            yield psutil.Process(process.pid)
        finally:
            process.kill()


def has_frame(path: Path, index: int) -> bool:
    """Whether a file that may still be written has a frame."""
    # The last message may be there in part, and at first none.
    with suppress(RuntimeError, ValueError):
        return path.exists() and index in read_saved_view(path, indexed=False).frames(
            "world/camera/image/depth"
        )
    return False


def connected(port: int, **settings: object) -> IsolatedView:
    config = ViewConfig(mode="connect", connect=f"{LOCAL}:{port}", mesh_step_px=20, **settings)  # type: ignore[arg-type]
    view = open_view(config, CONFIG)
    assert isinstance(view, IsolatedView)
    _views.append(view)
    return view


def show_all(view: IsolatedView, result: FrameResult, frames: int = FRAMES) -> float:
    """Show many frames, numbered; return the longest that one took, seconds."""
    longest_s = 0.0
    with FairClock() as clock:
        for index in range(frames):
            view.show(numbered(result, index))
            longest_s = max(longest_s, clock.lap_s())
    return longest_s


def close_in_time(view: IsolatedView) -> None:
    with FairClock() as clock:
        view.close()
    assert clock.elapsed_s < 2.0


def assert_file_is_whole(path: Path, frames: int = FRAMES) -> None:
    saved = read_saved_view(path)
    for entity in ("world/camera/image/depth", "world/surfaces", "tree"):
        assert saved.frames(entity) == list(range(frames))


def test_a_viewer_gets_frames_and_log_on_its_own_connection(tmp_path: Path, result: FrameResult) -> None:
    port, received = free_port(LOCAL), tmp_path / "received.rrd"
    with stand_in(port, save=received) as viewer:
        view = connected(port)
        wait_until(lambda: view.connections > 0, "a viewer takes frames")
        logging.getLogger("nurbseg").warning("look here")
        for index in range(5):
            view.show(numbered(result, index))
            time.sleep(0.1)
        close_in_time(view)
        viewer.send_signal(signal.SIGINT)
        viewer.wait(60.0)
    saved = read_saved_view(received, indexed=False)
    frames = saved.frames("world/camera/image/depth")
    assert frames[-1] == 4
    assert len(frames) + view.dropped == 5
    assert ("WARN", "look here") in saved.texts
    assert saved.static["world"]["ViewCoordinates:xyz"] == [[3, 2, 5]]


def test_a_frozen_viewer_delays_neither_the_frames_nor_the_file(
    tmp_path: Path, result: FrameResult, caplog: pytest.LogCaptureFixture
) -> None:
    port, path = free_port(LOCAL), tmp_path / "all.rrd"
    with stand_in(port) as viewer:
        view = connected(port, save=str(path))
        wait_until(lambda: view.connections > 0, "a viewer takes frames")
        viewer.suspend()
        longest_s = show_all(view, result)
        assert longest_s < 1.0
        assert view.dropped > FRAMES // 2
        wait_until(lambda: "is not responding" in caplog.text, "it is said that the viewer is frozen")
        close_in_time(view)
        assert viewer.status() == psutil.STATUS_STOPPED
    assert_file_is_whole(path)
    assert caplog.text.count("is not responding") == 1


def test_a_viewer_that_thaws_is_shown_to_again(result: FrameResult, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="nurbseg")
    port = free_port(LOCAL)
    with stand_in(port) as viewer:
        view = connected(port)
        wait_until(lambda: view.connections > 0, "a viewer takes frames")
        viewer.suspend()
        wait_until(
            lambda: (view.show(result), "is not responding" in caplog.text)[1],
            "the viewer is known to be frozen",
        )
        viewer.resume()
        wait_until(lambda: "accepts frames again" in caplog.text, "the viewer takes frames again")
        close_in_time(view)


def test_a_viewer_frozen_before_we_connect_does_no_harm(tmp_path: Path, result: FrameResult) -> None:
    port, path = free_port(LOCAL), tmp_path / "all.rrd"
    with stand_in(port) as viewer:
        viewer.suspend()
        view = connected(port, save=str(path))
        assert show_all(view, result) < 1.0
        close_in_time(view)
    assert_file_is_whole(path)


def test_an_absent_viewer_does_no_harm_and_is_named_once(
    tmp_path: Path, result: FrameResult, caplog: pytest.LogCaptureFixture
) -> None:
    port, path = free_port(LOCAL), tmp_path / "all.rrd"
    view = connected(port, save=str(path))
    assert show_all(view, result) < 1.0
    wait_until(lambda: "no viewer is listening" in caplog.text, "the absence is said")
    time.sleep(1.2)
    close_in_time(view)
    (said,) = [record for record in caplog.records if "no viewer is listening" in record.getMessage()]
    assert (said.name, said.levelname) == ("nurbseg.app.view.live", "WARNING")
    assert said.getMessage().startswith(f"no viewer is listening at rerun+http://{LOCAL}:{port}/proxy;")
    assert_file_is_whole(path)


def test_a_viewer_that_ends_at_once_is_reported_once(
    result: FrameResult, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # Without a display the viewer cannot open its window.
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    view = open_view(ViewConfig(mode="spawn", port=free_port(LOCAL)), CONFIG)
    view.show(result)
    wait_until(lambda: "the viewer ended at once (code 1)" in caplog.text, "the viewer's end is said")
    time.sleep(1.2)
    close_in_time(view)
    assert caplog.text.count("the viewer ended at once") == 1
    assert own_children() == []


def test_a_viewer_that_comes_late_is_shown_to(result: FrameResult) -> None:
    port = free_port(LOCAL)
    view = connected(port)
    view.show(result)
    with stand_in(port):
        wait_until(lambda: view.connections > 0, "a viewer takes frames")
        close_in_time(view)


def test_a_killed_viewer_is_noticed_once_and_shown_to_when_it_comes_back(
    tmp_path: Path, result: FrameResult, caplog: pytest.LogCaptureFixture
) -> None:
    port, path, received = free_port(LOCAL), tmp_path / "all.rrd", tmp_path / "received.rrd"
    with stand_in(port):
        view = connected(port, save=str(path))
        wait_until(lambda: view.connections > 0, "a viewer takes frames")
        view.show(numbered(result, 0))
    wait_until(lambda: "is gone" in caplog.text, "the loss is said")
    for index in range(1, 50):
        view.show(numbered(result, index))
    with stand_in(port, save=received) as viewer:
        wait_until(lambda: view.connections == 2, "the viewer is connected to again")
        view.show(numbered(result, 50))
        # Closing waits less than a second for a viewer, in which one beside other work may not read all.
        wait_until(lambda: has_frame(received, 50), "the newest frame is received")
        close_in_time(view)
        viewer.send_signal(signal.SIGINT)
        viewer.wait(60.0)
    assert caplog.text.count("is gone") == 1
    assert_file_is_whole(path, 51)
    again = read_saved_view(received, indexed=False)
    # The new viewer knows nothing of the old one: it gets the beginning too, and the newest frames only.
    assert again.static["world/camera"]["Pinhole:resolution"] == [[160, 120]]
    assert again.frames("world/camera/image/depth")[-1] == 50
    assert len(again.frames("world/camera/image/depth")) < 10


_SHOWS_AND_ENDS = """
    import sys
    from nurbseg.app.view.opening import open_view
    from nurbseg.app.settings.output_config import ViewConfig
    from tests.fakes.small_scene import CONFIG, small_result
    from tests.fakes.waiting import wait_until

    result = small_result()
    config = ViewConfig(mode="connect", connect=sys.argv[1], save=sys.argv[2], mesh_step_px=20)
    view = open_view(config, CONFIG)
    wait_until(lambda: view.connections > 0, "a viewer takes frames")
    print("connected", flush=True)
    sys.stdin.readline()
    try:
        while True:
            view.show(result)
            print("shown", flush=True)
    except KeyboardInterrupt:
        view.close()
        sys.exit(130)
"""


def test_ctrl_c_ends_the_process_in_time_though_the_viewer_is_frozen(tmp_path: Path) -> None:
    port, path = free_port(LOCAL), tmp_path / "all.rrd"
    with stand_in(port) as viewer:
        with subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(_SHOWS_AND_ENDS), f"{LOCAL}:{port}", str(path)],
            cwd=Path(__file__).parents[3],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stdout.readline() == "connected\n"
            viewer.suspend()
            process.stdin.write("go on\n")
            process.stdin.flush()
            for _ in range(FRAMES):
                assert process.stdout.readline() == "shown\n"
            with FairClock(process.pid) as clock:
                process.send_signal(signal.SIGINT)
                threading.Thread(target=process.stdout.read, daemon=True).start()
                # The interpreter's own end counts too: Rerun waits there for a viewer that takes nothing.
                assert process.wait(timeout=60.0) == 130
            assert clock.elapsed_s < 2.5
        assert viewer.status() == psutil.STATUS_STOPPED
    assert read_saved_view(path).frames("world/surfaces") == [0]


def listeners(process: psutil.Process) -> set[tuple[str, int]]:
    connections = process.net_connections("inet")
    return {tuple(connection.laddr) for connection in connections if connection.status == psutil.CONN_LISTEN}  # type: ignore[misc]


def test_a_served_page_listens_on_this_computer_only_and_ends_with_the_view(result: FrameResult) -> None:
    config = ViewConfig(mode="serve", port=0, web_port=0)
    view = open_view(config, CONFIG)
    assert isinstance(view, IsolatedView)
    try:
        view.show(result)
        assert view.serving
        (program,) = own_children()
        # Rerun's own server, which anyone could read, is gone.
        assert program.children() == []
        assert {address for address, _ in listeners(program)} == {LOCAL}
        assert len(listeners(program)) == 2
        assert listeners(psutil.Process()) == set()
        assert any(view.viewer_hint.startswith(f"http://{LOCAL}:{port}/#") for _, port in listeners(program))
    finally:
        close_in_time(view)
    assert own_children() == []


def test_a_taken_port_is_named_rather_than_served_silently_elsewhere() -> None:
    with socket.socket() as other:
        other.bind((LOCAL, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ViewError, match=rf"port {port} of 127\.0\.0\.1 is in use"):
            open_view(ViewConfig(mode="serve", port=port), CONFIG)


@pytest.fixture(scope="module")
def headless_viewer_port() -> Iterator[int]:
    """Start a real viewer that draws into memory; skipped where there is nothing to draw with."""
    port = free_port(LOCAL)
    cores = os.sched_getaffinity(0)
    try:
        # As the process of the view does.
        leave_a_core([threading.current_thread()])
        process = start_viewer(ViewConfig(), port, "--headless")
    finally:
        os.sched_setaffinity(0, cores)
    try:
        deadline_s = time.monotonic() + 60.0
        while not listens(LOCAL, port) and process.poll() is None and time.monotonic() < deadline_s:
            time.sleep(0.1)
        if process.poll() is not None:
            pytest.skip("no Vulkan driver to draw with: install mesa-vulkan-drivers")
        yield port
    finally:
        process.kill()
        process.wait()


def test_the_real_viewer_listens_on_this_computer_only(headless_viewer_port: int) -> None:
    (viewer,) = own_children()
    assert listeners(viewer) == {(LOCAL, headless_viewer_port)}


def test_the_real_viewer_uses_all_cores(headless_viewer_port: int) -> None:
    (viewer,) = own_children()
    assert os.sched_getaffinity(viewer.pid) == os.sched_getaffinity(0)


def test_the_real_viewer_shows_every_part_without_complaint(
    headless_viewer_port: int, result: FrameResult
) -> None:
    view = connected(headless_viewer_port)
    client = ViewerClient.connect(f"rerun+http://{LOCAL}:{headless_viewer_port}/proxy")
    try:
        wait_until(lambda: view.connections > 0, "a viewer takes frames")
        for index in range(3):
            view.show(numbered(result, index))
            time.sleep(0.2)
        wait_until(lambda: len(client.get_state().views) > 10, "the layout is there")
        wait_until(lambda: client.get_state().recordings[-1].current_timeline == "frame", "the time is shown")
        state = client.get_state()
    finally:
        close_in_time(view)
    names = {view.name for view in state.views}
    assert {"Tree", "Color", "Depth", "Ground truth", "Rate (1/s), latency (ms)", "Log", "Splits"} <= names
    assert {"Objects on color", "Surfaces", "Tree by object", "Surfaces, colored by residual"} <= names
    assert [(view.name, view.reports) for view in state.views if view.reports] == []
