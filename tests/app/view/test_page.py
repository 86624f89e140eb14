"""The served page: who may control a run, and what a browser shows and sends."""

from __future__ import annotations

import json
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest

from nurbseg.app.control.commands import RunState
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view import isolated
from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.page.board import Board
from nurbseg.app.view.page.door import DoorHandler, DoorServer
from nurbseg.app.view.page.server import PageHandler
from nurbseg.app.view.page.viewer_port import File, ViewerHandler
from nurbseg.app.view.viewer import free_port
from nurbseg.drivers.process.messages import Recorded
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import SegmentationConfig
from tests.fakes.browser import Browser
from tests.fakes.small_scene import CONFIG
from tests.fakes.waiting import wait_until

LOCAL = "127.0.0.1"
STATE = RunState(
    SegmentationConfig(metric="vgc", ratio_max=0.85),
    source="a.mcap",
    frame=12,
    recording=Recorded(Path("a.mcap"), (), seconds=4.0, written_mb=12.0, room_mb=1800.0),
    said="metric vgc",
)


@pytest.fixture
def page() -> Iterator[Any]:
    """A page without a viewer; `asked` are the commands that were given there."""
    asked: list[str] = []
    board = Board(lambda command, number: asked.append(command))
    port = free_port(LOCAL)
    with closing(DoorServer(LOCAL, port, PageHandler, viewer=2, board=board)):
        yield SimpleNamespace(board=board, asked=asked, port=port, url=f"http://{LOCAL}:{port}/")


def answered(request: urllib.request.Request) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(request, timeout=30.0) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as err:
        return err.code, err.read().decode()


def command_of(page: Any, line: str = "pause", **headers: str) -> urllib.request.Request:
    given = {"X-Token": page.board.token} | {name.replace("_", "-"): text for name, text in headers.items()}
    return urllib.request.Request(f"{page.url}run", line.encode(), given)


def test_a_command_with_the_token_is_passed_on(page: Any) -> None:
    # The answer is the number of the command.
    assert answered(command_of(page, "ratio 0.9\n")) == (202, "1")
    assert answered(command_of(page, Origin=page.url[:-1])) == (202, "2")
    for host in ("localhost", "[::1]", "192.168.1.7", socket.gethostname()):
        assert answered(command_of(page, "step", Host=f"{host}:{page.port}"))[0] == 202
    assert page.asked == ["ratio 0.9", "pause", *["step"] * 4]


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({"X_Token": ""}, "open the whole address"),
        ({"X_Token": "x" * 22}, "open the whole address"),
        ({"X_Token": "é"}, "open the whole address"),
        ({"Origin": "http://evil.example"}, "of another host"),
        ({"Origin": "null"}, "of another host"),
        ({"Origin": f"http://{LOCAL}:1"}, "of another host"),
        # A name that its owner's DNS has given this computer's address to.
        ({"Host": "evil.example", "Origin": "http://evil.example"}, "of another host"),
        ({"Host": ""}, "of another host"),
    ],
)
def test_others_neither_control_nor_see_the_run(page: Any, headers: dict[str, str], why: str) -> None:
    page.board.tell(STATE)
    request = command_of(page, **headers)
    status, text = answered(request)
    assert (status, why in text) == (403, True)
    status, text = answered(urllib.request.Request(f"{page.url}run?after=0", headers=request.headers))
    assert (status, why in text) == (403, True)
    assert page.asked == []


@pytest.mark.parametrize("line", ["", " ", "pause\nquit", "a" * 201])
def test_what_is_no_single_command_is_refused(page: Any, line: str) -> None:
    assert answered(command_of(page, line))[0] == 400
    assert page.asked == []


@pytest.mark.parametrize("length", ["", "-1", "201", "9" * 5000])
def test_a_command_of_any_other_length_is_refused(page: Any, length: str) -> None:
    assert answered(command_of(page, Content_Length=length))[0] == 400
    assert page.asked == []


def test_the_token_is_new_for_each_run_and_in_no_answer(page: Any) -> None:
    page.board.tell(STATE)
    assert len(page.board.token) >= 22
    assert Board(print).token != page.board.token
    for path in ("", "bar.js", "bar.css"):
        _, text = answered(urllib.request.Request(f"{page.url}{path}"))
        assert text
        assert page.board.token not in text


def test_a_state_is_sent_when_it_has_changed(page: Any) -> None:
    def fetched(after: int) -> dict[str, Any]:
        url = f"{page.url}run?after={after}"
        document: dict[str, Any] = json.loads(
            answered(urllib.request.Request(url, headers={"X-Token": page.board.token}))[1]
        )
        return document

    page.board.tell(STATE)
    first = fetched(0)
    assert first["status"][:3] == ["a.mcap", "rec 4.0 s, 12.0 MB, 3.0 MB/s, 10 min left", "frame 12"]
    assert (first["recording"], first["said"]) == ("12.0 MB, 10 min left", "metric vgc")
    assert (first["values"]["T"], first["values"]["Metric"], first["values"]["Back"]) == (0.85, "vgc", None)
    assert {widget["label"] for widget in first["widgets"]} == set(first["values"])
    page.board.tell(replace(STATE, paused=True))
    second = fetched(first["version"])
    assert second["version"] == first["version"] + 1
    assert second["values"]["Pause"] is True
    assert "widgets" not in second


def test_a_command_does_not_wait_until_a_frame_is_drawn(
    small_result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []
    draw, arrived = isolated.drawn, threading.Event()

    def drawn_late(*arguments: Any, **options: Any) -> ViewFrame:
        assert arrived.wait(60.0)
        return draw(*arguments, **options)

    def take(*command: Any) -> None:
        asked.append(command)
        arrived.set()

    monkeypatch.setattr(isolated, "drawn", drawn_late)
    with open_view(ViewConfig(mode="serve", port=0, web_port=0), CONFIG, ask=take) as view:
        view.show(small_result)
        address, _, token = view.viewer_hint.partition("#")
        run = f"{address}run"
        assert answered(urllib.request.Request(run, b"pause", {"X-Token": token})) == (202, "1")
        wait_until(lambda: len(asked) == 1, "the command arrives", 30.0)


def test_state_and_commands_pass_between_the_run_and_its_page() -> None:
    asked: list[tuple[str, int]] = []
    with open_view(
        ViewConfig(mode="serve", port=0, web_port=0), CONFIG, ask=lambda *command: asked.append(command)
    ) as view:
        address, _, token = view.viewer_hint.partition("#")
        run = f"{address}run"
        view.tell(STATE)
        text = answered(urllib.request.Request(f"{run}?after=0", headers={"X-Token": token}))[1]
        assert "metric vgc" in json.loads(text)["said"]
        for line in ("pause", "ratio 0.9"):
            assert answered(urllib.request.Request(run, line.encode(), {"X-Token": token}))[0] == 202
        wait_until(lambda: len(asked) == 2, "the commands arrive")
        assert asked == [("pause", 1), ("ratio 0.9", 2)]


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with closing(Browser(tmp_path / "profile")) as browser:
        yield browser


def control(label: str) -> str:
    return f"""document.querySelector('[data-label="{label}"]')"""


def test_a_browser_shows_the_state_and_sends_what_is_pressed(page: Any, browser: Browser) -> None:
    page.board.tell(STATE)
    browser.open(f"{page.url}#{page.board.token}")
    browser.wait_for("document.querySelectorAll('[data-label]').length === 11")
    assert "a.mcap" in browser.evaluate("document.getElementById('status').innerText")
    assert browser.evaluate(f"{control('Metric')}.value + {control('T')}.value") == "vgc0.85"
    assert browser.evaluate(f"{control('Record')}.innerText") == "12.0 MB, 10 min left"
    assert browser.evaluate(f"[{control('Back')}.disabled, {control('Step')}.disabled]") == [True, False]
    for label in ("Pause", "Record"):
        browser.evaluate(f"{control(label)}.click()")
    for label, value in (("Metric", "mse"), ("T", "0.9")):
        browser.evaluate(f"{control(label)}.value = '{value}'")
        browser.evaluate(f"{control(label)}.dispatchEvent(new Event('change'))")
    # The mark is there at once, and stays until the run has answered.
    assert browser.evaluate(f"{control('Pause')}.classList.contains('pending')")
    wait_until(lambda: len(page.asked) == 4, "all commands arrive")
    assert page.asked == ["pause", "record off", "metric mse", "ratio 0.9"]
    # A state from before the commands neither takes the mark away, nor what was chosen.
    page.board.tell(replace(STATE, frame=13))
    browser.wait_for("document.getElementById('status').innerText.includes('frame 13')")
    assert browser.evaluate(f"{control('Pause')}.classList.contains('pending')")
    assert browser.evaluate(f"{control('Metric')}.value + {control('T')}.value") == "mse0.9"
    page.board.tell(replace(STATE, paused=True, said="a <b>bold</b> word", refused=True, answered=3))
    browser.wait_for(f"{control('Pause')}.getAttribute('aria-pressed') === 'true'")
    pending = "[...document.querySelectorAll('.pending')].map(each => each.dataset.label)"
    assert browser.evaluate(pending) == ["T"]
    # A change that was refused is taken back.
    assert browser.evaluate(f"{control('Metric')}.value") == "vgc"
    assert browser.evaluate("document.getElementById('said').textContent") == "a <b>bold</b> word"
    browser.evaluate(f"{control('Pause')}.click()")
    wait_until(lambda: page.asked[-1] == "resume", "the other command of the switch arrives")
    assert browser.errors == []


def test_a_browser_opens_the_explanation_that_was_asked_for(
    page: Any, browser: Browser, small_result: FrameResult, tmp_path: Path
) -> None:
    path = tmp_path / "why.html"
    small_result.explain().save(path)
    page.board.tell(STATE)
    browser.open(f"{page.url}#{page.board.token}")
    browser.wait_for("document.querySelectorAll('[data-label]').length === 11")
    browser.evaluate(f"{control('Explain')}.click()")
    wait_until(lambda: page.asked == ["explain"], "the command arrives")
    page.board.tell(replace(STATE, explained=str(path), answered=1))
    why = "document.getElementById('why')"
    browser.wait_for(f"!{why}.hidden")
    assert browser.evaluate(f"{why}.querySelector('iframe').srcdoc") == path.read_text(encoding="utf-8")
    # A frame of such a text has the policy of its page: in the dark style of its own, it is not white.
    picture = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.median(picture) < 64
    assert (picture > 200).sum() > 500
    browser.evaluate(f"{why}.querySelector('button').click()")
    assert browser.evaluate(f"{why}.hidden")
    # Nobody else gets it.
    for token, status in (("", 403), (page.board.token, 200)):
        request = urllib.request.Request(f"{page.url}explanation", headers={"X-Token": token})
        assert answered(request)[0] == status
    path.unlink()
    assert answered(request) == (404, "the explanation cannot be read: No such file or directory")


def test_a_browser_without_the_token_says_what_to_open(page: Any, browser: Browser) -> None:
    page.board.tell(STATE)
    browser.open(page.url)
    browser.wait_for("document.getElementById('said').innerText.includes('open the whole address')")
    assert browser.evaluate("document.querySelectorAll('[data-label]').length") == 0


def test_the_viewer_is_a_page_of_another_origin(page: Any, browser: Browser) -> None:
    browser.open(f"{page.url}?renderer=webgl#{page.board.token}")
    browser.wait_for("!!document.getElementById('viewer')?.src")
    source = urlsplit(browser.evaluate("document.getElementById('viewer').src"))
    assert (source.hostname, source.port, source.path) == (LOCAL, 2, "/")
    assert parse_qs(source.query) == {"renderer": ["webgl"], "url": [f"rerun+http://{LOCAL}:2/proxy"]}
    assert page.board.token not in source.geturl()
    # Its scripts do not see the key to the frames.
    assert browser.evaluate("document.cookie") == ""


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (2560, 1440), (390, 844)])
def test_the_bar_fits_on_a_screen_and_can_be_touched(
    page: Any, browser: Browser, width: int, height: int
) -> None:
    page.board.tell(STATE)
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.call("Emulation.setDeviceMetricsOverride", **size)
    browser.open(f"{page.url}#{page.board.token}")
    browser.wait_for("document.querySelectorAll('[data-label]').length === 11")
    elements = "[...document.querySelectorAll('[data-label], #viewer')]"
    boxes = f"{elements}.map(each => each.getBoundingClientRect())"
    found = browser.evaluate(f"{boxes}.map(({{x, y, width, height}}) => [x, y, width, height])")
    shown = [each for each in found if each[2] > 0]
    assert len(shown) >= 6
    for x, y, wide, high in shown:
        assert x >= 0
        assert x + wide <= width
        assert y + high <= height
        assert high >= (44 if width < 500 else 30)
    assert found[0][3] > 0.7 * height
    if width < 500:
        assert len(shown) < len(found)
        browser.evaluate("document.getElementById('more').click()")
        assert all(each > 0 for each in browser.evaluate(f"{boxes}.map(({{width}}) => width)"))


BUSY = """<script>
    const said = new XMLHttpRequest(); said.open("POST", "/busy", false); said.send("x");
    for (;;);
</script>"""


class Stream:
    """Frames that nobody has asked for."""


def test_the_bar_works_beside_a_viewer_that_is_busy(
    browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []
    board = Board(lambda *command: asked.append(command))
    port, viewer_port = free_port(LOCAL), free_port(LOCAL)
    busy = threading.Event()
    monkeypatch.setattr(DoorHandler, "is_ours", lambda self: self.path != "/busy" or busy.set())
    pages = {"/": File("text/html", BUSY.encode())}
    frames: Any = Stream()
    with (
        closing(DoorServer(LOCAL, port, PageHandler, viewer=viewer_port, board=board)),
        closing(
            DoorServer(
                LOCAL, viewer_port, ViewerHandler, page=port, cookie="none", files=pages, frames=frames
            )
        ),
    ):
        board.tell(STATE)
        browser.open(f"http://{LOCAL}:{port}/#{board.token}")
        assert busy.wait(90.0)
        browser.wait_for(f"{control('Pause')} !== null")
        # The browser names it beside the pages only if it has a process of its own.
        targets = browser.call("Target.getTargets")["targetInfos"]
        assert [
            each["url"] for each in targets if each["type"] == "iframe" and f":{viewer_port}/" in each["url"]
        ]
        browser.evaluate(f"{control('Pause')}.click()")
        wait_until(lambda: asked == [("pause", 1)], "the command arrives")
        board.tell(replace(STATE, paused=True))
        browser.wait_for(f"{control('Pause')}.getAttribute('aria-pressed') === 'true'")
