"""The served page and its server: what they ask of other hosts, and what becomes of them."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view import serving
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.serving import WebServer
from nurbseg.app.view.view import View
from nurbseg.app.view.viewer import free_port, listens, private_environment
from tests.fakes.own_children import own_children
from tests.fakes.small_scene import CONFIG, small_result
from tests.fakes.waiting import wait_until

LOCAL = "127.0.0.1"
ANY_PORTS = ViewConfig(mode="serve", port=0, web_port=0)

_SERVES = """
    import sys
    from nurbseg.app.view.opening import open_view
    from nurbseg.app.settings.output_config import ViewConfig
    from tests.fakes.small_scene import CONFIG, small_result
    from tests.fakes.waiting import wait_until

    with open_view(ViewConfig(mode="serve", port=0, web_port=0), CONFIG) as view:
        wait_until(lambda: view.connections > 0, "a viewer takes frames")
        view.show(small_result())
        print(view.viewer_hint, flush=True)
        sys.stdin.readline()
"""


def serving_program(*before: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*before, sys.executable, "-c", textwrap.dedent(_SERVES)],
        cwd=Path(__file__).parents[3],
        env={name: value for name, value in os.environ.items() if name != "CI"} | environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def view() -> Iterator[View]:
    with open_view(ANY_PORTS, CONFIG) as view:
        view.show(small_result())
        yield view


def fetched(url: str) -> tuple[bytes, dict[str, str]]:
    with urllib.request.urlopen(url, timeout=60.0) as answer:
        return answer.read(), dict(answer.headers)


def test_the_page_may_connect_to_its_server_only(view: View) -> None:
    stream_port = urlsplit(view.viewer_hint).query.rpartition("%3A")[2].partition("%2F")[0]
    wait_until(lambda: listens(LOCAL, int(stream_port)), "the server listens")
    page, headers = fetched(view.viewer_hint.replace("/?", "/viewer?"))
    policy = dict(word.strip().split(" ", 1) for word in headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == "'self'"
    web_port = urlsplit(view.viewer_hint).port
    ours = {"'self'", f"http://{LOCAL}:{web_port}", f"http://localhost:{web_port}"}
    assert set(policy.pop("frame-src").split()) == set(policy.pop("frame-ancestors").split()) == ours
    assert set(policy["connect-src"].split()) == {"'self'", "data:", "blob:", f"http://{LOCAL}:{stream_port}"}
    for each in policy.values():
        assert re.findall(r"https?://[^ ]*", each) in ([], [f"http://{LOCAL}:{stream_port}"])
    # A browser connects to the hosts of links ahead of time, whatever the policy.
    assert re.findall(rb"<link[^>]*//", page) == []
    assert b"re_viewer.js" in page


def test_the_parts_of_the_page_come_whole(view: View) -> None:
    base = view.viewer_hint.partition("?")[0]
    script, headers = fetched(f"{base}re_viewer.js")
    assert b"wasm_bindgen" in script
    assert "javascript" in headers["Content-Type"]
    program, headers = fetched(f"{base}re_viewer_bg.wasm")
    assert program[:4] == b"\0asm"
    assert len(program) == int(headers["rerun-final-length"])


def test_a_browser_asks_no_other_host_for_anything(view: View, tmp_path: Path) -> None:
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("no Chromium to open the page with: install chromium")
    log = tmp_path / "net.json"
    words = [
        *(browser, "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--no-first-run"),
        *("--enable-unsafe-swiftshader", f"--user-data-dir={tmp_path / 'profile'}"),
        *(
            f"--log-net-log={log}",
            "--remote-debugging-port=0",
            view.viewer_hint.replace("#", "&renderer=webgl#"),
        ),
    ]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            wait_until(
                lambda: log.exists() and "/ReadMessages" in log.read_text(), "it asks for frames", 200.0
            )
            time.sleep(2.0)
        finally:
            process.terminate()
    text = log.read_text()
    events = []
    for line in text.splitlines():
        if not line.startswith("{"):
            continue
        # An event is a line; a browser that is ended need not end its log, nor the line that it writes.
        with suppress(json.JSONDecodeError):
            events.append(json.JSONDecoder().raw_decode(line)[0])
    ours = {LOCAL, "localhost"}
    requests = [event["params"] for event in events if "initiator" in event.get("params", {})]
    asked = [request["url"] for request in requests if urlsplit(request["initiator"]).hostname in ours]
    assert {urlsplit(url).hostname for url in asked} == ours
    names = re.findall(r'"host":"([^"]*)"', text)
    assert [name for name in names if "rerun" in name or "github" in name or "fonts" in name] == []


def test_serving_looks_no_name_up_and_connects_to_this_computer_only(tmp_path: Path) -> None:
    if shutil.which("strace") is None:
        pytest.skip("no strace to watch connections with: install strace")
    trace = tmp_path / "trace"
    # Rerun begins to send with its second run.
    for _ in range(2):
        watch = (
            "strace",
            "-f",
            "-q",
            "--seccomp-bpf",
            "-e",
            "trace=connect,sendto,sendmmsg",
            "-o",
            str(trace),
        )
        with serving_program(*watch, HOME=str(tmp_path)) as program:
            assert program.stdout is not None
            assert program.stdout.readline().startswith("http://")
            time.sleep(3.0)
            program.communicate("\n", timeout=60.0)
        assert program.returncode == 0
        connects = [line for line in trace.read_text().splitlines() if "sa_family=AF_INET" in line]
        assert connects
        for line in connects:
            assert LOCAL in line, line
            assert "htons(53)" not in line, line
    assert list(tmp_path.rglob("analytics*")) == []


def test_started_programs_are_set_to_send_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.delenv("CI", raising=False)
    environment = private_environment()
    assert environment["CI"] == "true"
    assert "FORCE_RERUN_ANALYTICS" not in environment
    assert environment["PATH"] == os.environ["PATH"]


def test_the_server_ends_with_those_that_started_it_however_they_end() -> None:
    with serving_program() as program:
        assert program.stdout is not None
        program.stdout.readline()
        main = psutil.Process(program.pid)
        (shows,) = main.children()
        (server,) = shows.children()
        assert "rerun" in server.name()
        # Stopped, so that it cannot end the server in its turn.
        main.suspend()
        shows.kill()
        main.kill()
        server.wait(30.0)
        program.wait(30.0)


def test_a_server_that_ends_is_started_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(serving, "_LASTING_S", 0.0)
    with closing(WebServer(ANY_PORTS, print)) as server:
        port = urlsplit(server.url).port
        assert port is not None
        wait_until(lambda: listens(LOCAL, port), "the server listens")
        (process,) = own_children()
        process.kill()
        wait_until(lambda: not server.is_starting(), "the server has ended")
        server.restart_if_ended()
        assert "the web server ended by signal 9 and is being restarted; reload the page" in caplog.text
        wait_until(lambda: listens(LOCAL, port), "the server listens again")
        wait_until(
            lambda: b"re_viewer.js" in fetched(server.page_url.replace("/?", "/viewer?"))[0],
            "the page is served again",
        )
        server.restart_if_ended()
        assert len(caplog.records) == 1
    assert own_children() == []


def test_a_server_that_ends_at_once_is_given_up(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(serving, "_LASTING_S", 1e9)
    with closing(WebServer(ANY_PORTS, print)) as server:
        (process,) = own_children()
        process.kill()
        wait_until(lambda: not server.is_starting(), "the server has ended")
        server.restart_if_ended()
        server.restart_if_ended()
        assert [record.getMessage() for record in caplog.records] == [
            "the web server ended by signal 9 soon after its start and will not be restarted"
        ]
        assert own_children() == []


def test_a_view_whose_server_was_killed_shows_again(view: View, caplog: pytest.LogCaptureFixture) -> None:
    began_s = time.monotonic()
    wait_until(lambda: view.connections > 0, "a viewer takes frames")
    (shows,) = own_children()
    time.sleep(max(0.0, began_s + 6.0 - time.monotonic()))
    (server,) = shows.children()
    server.kill()
    wait_until(lambda: "is being restarted" in caplog.text, "the start is said")
    wait_until(lambda: view.connections == 2, "frames are sent again")


def test_a_taken_web_port_leaves_no_server() -> None:
    port = free_port(LOCAL)
    first = WebServer(ViewConfig(mode="serve", port=0, web_port=port), print)
    try:
        with pytest.raises(ViewError, match=f"web port {port} of {LOCAL} is in use"):
            WebServer(ViewConfig(mode="serve", port=0, web_port=port), print)
        assert len(own_children()) == 1
    finally:
        first.close()
