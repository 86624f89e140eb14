"""The served page: who sees the frames, and what it asks of other hosts."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import textwrap
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import psutil
import pytest

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.isolated import IsolatedView
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.page.frames import READ_MESSAGES
from nurbseg.app.view.viewer import free_port, private_environment
from tests.fakes.browser import Browser
from tests.fakes.own_children import own_children
from tests.fakes.saved_view import SavedView, read_saved_view
from tests.fakes.small_scene import CONFIG, numbered, small_result
from tests.fakes.waiting import wait_until

LOCAL = "127.0.0.1"
ANY_PORTS = ViewConfig(mode="serve", port=0, web_port=0)

_SERVES = """
    import sys
    from nurbseg.app.view.opening import open_view
    from nurbseg.app.settings.output_config import ViewConfig
    from tests.fakes.small_scene import CONFIG, small_result

    with open_view(ViewConfig(mode="serve", port=0, web_port=0), CONFIG) as view:
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


class Served(NamedTuple):
    """A served view: its page, and what those who know its token know."""

    view: IsolatedView
    page: str
    token: str
    port: int
    cookie: str

    def frames(self, **headers: str) -> urllib.request.Request:
        """Return the request that Rerun's viewer sends for frames."""
        url = f"http://{LOCAL}:{self.port}{READ_MESSAGES}"
        given = {"Content-Type": "application/grpc-web+proto", "Cookie": self.cookie} | headers
        return urllib.request.Request(url, struct.pack(">BI", 0, 0), given)


def served(config: ViewConfig = ANY_PORTS) -> Served:
    view = open_view(config, CONFIG)
    assert isinstance(view, IsolatedView)
    page, _, token = view.viewer_hint.partition("#")
    with urllib.request.urlopen(
        urllib.request.Request(f"{page}viewer", headers={"X-Token": token}), timeout=60.0
    ) as answer:
        cookie = answer.headers["Set-Cookie"].partition(";")[0]
        return Served(view, page, token, int(answer.read()), cookie)


@pytest.fixture
def run() -> Iterator[Served]:
    run = served()
    with run.view:
        run.view.show(small_result())
        yield run


def fetched(url: str) -> tuple[bytes, dict[str, str]]:
    with urllib.request.urlopen(url, timeout=60.0) as answer:
        return answer.read(), dict(answer.headers)


def refused(request: urllib.request.Request | str) -> str:
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(request, timeout=60.0)
    assert caught.value.code in (403, 404)
    return caught.value.read().decode()


class Watching(threading.Thread):
    """Receives frames as a browser does, until the server ends the stream."""

    def __init__(self, run: Served) -> None:
        super().__init__()
        self._answer = urllib.request.urlopen(run.frames(), timeout=60.0)
        self.content = b""
        self.start()

    def run(self) -> None:
        while part := self._answer.read1(1 << 20):
            self.content += part

    def saved(self, path: Path) -> SavedView:
        """Write what came as a recording of Rerun's, and read that."""
        position, messages = 0, []
        while position < len(self.content):
            kind, size = struct.unpack_from(">BI", self.content, position)
            position += 5 + size
            messages.append((kind, self.content[position - size : position]))
        assert messages.pop() == (0x80, b"grpc-status:0\r\n")
        with path.open("wb") as file:
            # Of the version that wrote it, uncompressed or not by each message, in protobuf.
            file.write(b"RRF2" + bytes([0, 41, 0, 0]) + bytes([1, 2, 0, 0]))
            for _, content in messages:
                _, content = field_of(content)
                kind, content = field_of(content)
                file.write(struct.pack("<QQ", kind, len(content)) + content)
        return read_saved_view(path, indexed=False)


def field_of(message: bytes) -> tuple[int, bytes]:
    """Return number and content of the only field of a protobuf message."""
    size, shift, position = 0, 0, 1
    while True:
        size |= (message[position] & 0x7F) << shift
        shift, position = shift + 7, position + 1
        if message[position - 1] < 0x80:
            break
    assert len(message) == position + size
    return message[0] >> 3, message[position:]


DEPTH = "world/camera/image/depth"


def test_each_browser_gets_the_frames_of_before_and_those_to_come(run: Served, tmp_path: Path) -> None:
    result = small_result()

    watching = [Watching(run)]
    for index in range(1, 4):
        before = len(watching[0].content)
        run.view.show(numbered(result, index))
        wait_until(lambda before=before: len(watching[0].content) > before, "a frame arrives")
    watching.append(Watching(run))
    run.view.show(numbered(result, 4))
    run.view.close()
    for each in watching:
        each.join(30.0)
    first, second = (each.saved(tmp_path / f"{n}.rrd") for n, each in enumerate(watching))
    # One that was shown while another was encoded may be missing, but for both.
    assert first.frames(DEPTH) == second.frames(DEPTH)
    assert {0, 4} < set(first.frames(DEPTH))
    for saved in (first, second):
        assert saved.static["world"]["ViewCoordinates:xyz"] == [[3, 2, 5]]
    assert run.view.connections == 2


def test_a_browser_that_takes_nothing_gets_the_newest_frame_then_and_delays_nobody(
    run: Served, tmp_path: Path
) -> None:
    result = small_result()
    slow = urllib.request.urlopen(run.frames(), timeout=60.0)
    fast = Watching(run)
    for index in range(1, 300):
        before = len(fast.content)
        run.view.show(numbered(result, index))
        wait_until(lambda before=before: len(fast.content) > before, "a frame arrives")
    late = Watching.__new__(Watching)
    threading.Thread.__init__(late)
    late._answer, late.content = slow, b""
    late.start()
    wait_until(lambda: len(late.content) > 1 << 20, "it takes frames again")
    run.view.close()
    for each in (fast, late):
        each.join(30.0)
    frames = fast.saved(tmp_path / "fast.rrd").frames(DEPTH)
    assert frames[-1] == 299 and len(frames) > 250
    frames = late.saved(tmp_path / "slow.rrd").frames(DEPTH)
    assert frames[-1] == 299 and len(frames) < 150


def test_frames_are_for_those_who_opened_the_page_with_its_token(run: Served) -> None:
    with urllib.request.urlopen(run.frames(), timeout=60.0) as answer:
        assert answer.read(5)[0] == 0
    name = run.cookie.partition("=")[0]
    for headers in (
        {"Cookie": ""},
        {"Cookie": f"{name}=guess"},
        {"Cookie": f"{name}={run.token}"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
        {"Host": f"evil.example:{run.port}"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
    ):
        assert "open the" in refused(run.frames(**headers))
    for token in ("", "guess", run.cookie.partition("=")[2]):
        request = urllib.request.Request(f"{run.page}viewer", headers={"X-Token": token})
        assert "open the whole address" in refused(request)
        assert "open the whole address" in refused(f"{run.page}objects")
    other = READ_MESSAGES.replace("Read", "Write")
    request = run.frames()
    request.full_url = f"http://{LOCAL}:{run.port}{other}"
    assert "only frames" in refused(request)


def test_the_page_and_the_viewer_may_connect_to_their_servers_only(run: Served) -> None:
    web_port = urlsplit(run.page).port
    for url, others in ((run.page, run.port), (f"http://{LOCAL}:{run.port}/", web_port)):
        page, headers = fetched(url)
        policy = dict(word.strip().split(" ", 1) for word in headers["Content-Security-Policy"].split(";"))
        assert policy["default-src"] == "'self'"
        assert set(policy.get("connect-src", "'self'").split()) <= {"'self'", "data:", "blob:"}
        hosts = {host for words in policy.values() for host in re.findall(r"https?://[^ ]*", words)}
        assert hosts == {f"http://{LOCAL}:{others}"}
        # A browser connects to the hosts of links ahead of time, whatever the policy.
        assert re.findall(rb"<link[^>]*//", page) == []
    assert b"re_viewer.js" in page
    program, headers = fetched(f"http://{LOCAL}:{run.port}/re_viewer_bg.wasm")
    assert program[:4] == b"\0asm"
    assert len(program) == int(headers["rerun-final-length"])


class Evil(BaseHTTPRequestHandler):
    """The page of another site, which does nothing by itself."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


def listening(processes: list[psutil.Process]) -> set[int]:
    return {
        each.laddr.port
        for process in processes
        for each in process.net_connections("tcp")
        if each.status == psutil.CONN_LISTEN
    }


def test_no_page_of_another_site_reads_or_sets_anything(run: Served, tmp_path: Path) -> None:
    ports = listening(psutil.Process().children(recursive=True))
    assert ports == {run.port, urlsplit(run.page).port}
    attack = """async (url, method) => {
        try {
            const body = method === "POST" ? new Uint8Array(5) : undefined;
            const headers = method === "POST" ? {"Content-Type": "application/grpc-web+proto"} : {};
            const answer = await fetch(url, {method, body, headers, credentials: "include"});
            if (answer.status !== 200) return "";
            return url + " " + (await answer.body.getReader().read()).value.length;
        } catch { return ""; }
    }"""
    with ThreadingHTTPServer((LOCAL, 0), Evil) as site:
        threading.Thread(target=site.serve_forever).start()
        # The user has the run's own page open, too; names of the attacker's resolve to this computer.
        with closing(Browser(tmp_path / "profile", rules="MAP *.test 127.0.0.1")) as browser:
            browser.open(f"{run.page}#{run.token}")
            browser.wait_for("document.getElementById('viewer').src")
            read = []
            for origin in (
                f"http://evil.test:{site.server_port}",
                *(f"http://evil.test:{port}" for port in ports),
            ):
                browser.open(f"{origin}/")
                browser.wait_for(f"location.origin === '{origin}'")
                for port in ports:
                    for host in (LOCAL, "localhost", "evil.test"):
                        for path, method in (
                            ("/run", "GET"),
                            ("/objects", "GET"),
                            ("/viewer", "GET"),
                            ("/run", "POST"),
                            (READ_MESSAGES, "POST"),
                        ):
                            url = f"http://{host}:{port}{path}"
                            read.append(browser.evaluate(f"({attack})('{url}', '{method}')"))
        site.shutdown()
    assert len(read) == 90 and set(read) == {""}


def test_a_browser_asks_no_other_host_for_anything(run: Served, tmp_path: Path) -> None:
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
            run.view.viewer_hint.replace("#", "?renderer=webgl#"),
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
    ours = {LOCAL}
    requests = [event["params"] for event in events if "initiator" in event.get("params", {})]
    asked = [request["url"] for request in requests if urlsplit(request["initiator"]).hostname in ours]
    assert {urlsplit(url).hostname for url in asked} == ours
    names = re.findall(r'"host":"([^"]*)"', text)
    assert [name for name in names if "rerun" in name or "github" in name or "fonts" in name] == []


def test_serving_looks_no_name_up_and_connects_to_this_computer_only(tmp_path: Path) -> None:
    if shutil.which("strace") is None:
        pytest.skip("no strace to watch connections with: install strace")
    trace = tmp_path / "trace"
    # Functions that are compiled already: only the connections are of interest.
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
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
        with serving_program(*watch, HOME=str(tmp_path), XDG_CACHE_HOME=cache) as program:
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


def test_a_taken_web_port_leaves_no_server() -> None:
    port = free_port(LOCAL)
    first = served(ViewConfig(mode="serve", port=0, web_port=port))
    with first.view:
        with pytest.raises(ViewError, match=f"web port {port} of {LOCAL} is in use"):
            open_view(ViewConfig(mode="serve", port=0, web_port=port), CONFIG)
        assert len(own_children()) == 1
