"""Objects corrected in a browser: what it shows of them, what a click chooses, and what is sent."""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nurbseg import Annotation
from nurbseg.app.control.commands import RunState
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.page import server
from nurbseg.app.view.page.board import Board
from nurbseg.app.view.page.server import PageServer
from nurbseg.app.view.viewer import free_port
from nurbseg.library.result import FrameResult
from tests.fakes.browser import Browser
from tests.fakes.small_scene import CONFIG, small_result
from tests.fakes.waiting import wait_until

LOCAL = "127.0.0.1"
STATE = RunState(CONFIG, source="a.mcap", frame=0, paused=True)
#: Column and row of a pixel of the wall, of the box before it, and of one without depth beside the wall.
WALL, BOX, NOTHING = (20, 100), (70, 60), (1, 60)


def shown(result: FrameResult) -> ViewFrame:
    return drawn(result, ViewConfig(), "mse")


@pytest.fixture
def page() -> Iterator[Any]:
    asked: list[str] = []
    board = Board(lambda command: asked.append(command.command))
    port = free_port(LOCAL)
    with closing(PageServer(LOCAL, port, (LOCAL, 1), 2, board)):
        yield SimpleNamespace(board=board, asked=asked, url=f"http://{LOCAL}:{port}/")


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with closing(Browser(tmp_path / "profile")) as browser:
        yield browser


def objects(page: Any, token: str) -> dict[str, Any]:
    request = urllib.request.Request(f"{page.url}objects", headers={"X-Token": token})
    with urllib.request.urlopen(request, timeout=30.0) as answer:
        document: dict[str, Any] = json.loads(answer.read())
    return document


def test_the_labels_are_sent_exactly_and_only_to_those_with_the_token(page: Any) -> None:
    assert objects(page, page.board.token) == {}
    result = small_result()
    page.board.show(shown(result))
    document = objects(page, page.board.token)
    labels, lengths = document["runs"][::2], document["runs"][1::2]
    found = np.repeat(labels, lengths).reshape(document["height"], document["width"])
    assert np.array_equal(found, result.labels("objects"))
    assert all(one != other for one, other in pairwise(labels))
    with pytest.raises(urllib.error.HTTPError, match="403"):
        objects(page, "x" * 22)


def test_a_frame_in_a_pause_is_a_change_and_one_of_a_running_replay_is_not(page: Any) -> None:
    def version(limit_s: float, after: int) -> tuple[int, int]:
        document = json.loads(page.board.wait(after, limit_s))
        return document["version"], document["shown"]

    page.board.tell(replace(STATE, paused=False))
    page.board.show(shown(small_result()))
    assert version(0.0, 0) == (1, 1)
    page.board.tell(STATE)
    page.board.show(shown(small_result(1)))
    assert version(30.0, 2) == (3, 2)


def test_frames_reach_the_page_of_a_run() -> None:
    with open_view(ViewConfig(mode="serve", port=0, web_port=0), CONFIG) as view:
        address, _, token = view.viewer_hint.partition("#")
        view.tell(STATE)
        view.show(small_result())
        served = SimpleNamespace(url=address.partition("?")[0])
        wait_until(lambda: objects(served, token).get("width") == 160, "the frame is there", 60.0)


class Corrector:
    """The part of the page that corrects objects."""

    def __init__(self, browser: Browser) -> None:
        self.browser = browser

    def press(self, label: str) -> None:
        self.browser.evaluate(f"{self._button(label)}.click()")

    def usable(self) -> list[str]:
        found: list[str] = self.browser.evaluate(
            "[...document.querySelectorAll('nav button:enabled')].map(each => each.textContent)"
        )
        return found

    def click(self, column: float, row: float) -> None:
        """Click at a pixel of the photo, with the mouse."""
        x, y = self.browser.evaluate(
            f"""(() => {{
                const box = canvas.getBoundingClientRect();
                const scale = Math.min(box.width / 160, box.height / 120);
                return [box.left + box.width / 2 + ({column} + 0.5 - 80) * scale,
                        box.top + box.height / 2 + ({row} + 0.5 - 60) * scale];
            }})()"""
        )
        for kind in ("mousePressed", "mouseReleased"):
            where = {"x": x, "y": y, "button": "left", "clickCount": 1}
            self.browser.call("Input.dispatchMouseEvent", type=kind, **where)

    def color(self, column: int, row: int) -> list[int]:
        """The color in the middle of a pixel of the photo, as the canvas shows it."""
        place = f"({column} + 0.5) * canvas.width / 160, ({row} + 0.5) * canvas.height / 120"
        data = f"canvas.getContext('2d').getImageData({place}, 1, 1).data"
        found: list[int] = self.browser.evaluate(f"[...{data}].slice(0, 3)")
        return found

    def _button(self, label: str) -> str:
        return f"[...document.querySelectorAll('button')].find(each => each.textContent === '{label}')"


@pytest.fixture
def corrector(page: Any, browser: Browser) -> Corrector:
    page.board.tell(STATE)
    page.board.show(shown(small_result()))
    browser.open(f"{page.url}#{page.board.token}")
    browser.wait_for("document.querySelectorAll('[data-label]').length > 10")
    return Corrector(browser)


def test_objects_are_chosen_by_clicks_and_merged_split_undone_and_saved(
    page: Any, corrector: Corrector
) -> None:
    result = small_result()
    labels = result.labels("objects")
    box, wall = (int(labels[row, column]) for column, row in (BOX, WALL))
    browser = corrector.browser
    assert browser.evaluate("canvas.getBoundingClientRect().width") == 0
    corrector.press("Correct")
    browser.wait_for("picture !== null")
    assert browser.evaluate("picture.places.map(each => each.label)") == [wall, box]
    assert corrector.usable() == ["Save"]
    plain = corrector.color(*BOX)
    # Beside the number, which is in its middle.
    corrector.click(BOX[0], BOX[1] + 15)
    assert browser.evaluate("[...chosen]") == [box]
    assert corrector.usable() == ["Split", "Split all", "Save"]
    assert corrector.color(BOX[0] + 10, BOX[1] + 15) != plain
    # Where there is no depth the object nearby is meant.
    corrector.click(*NOTHING)
    assert browser.evaluate("[...chosen]") == [box, wall]
    assert corrector.usable() == ["Merge", "Save"]
    corrector.press("Merge")
    wait_until(lambda: page.asked == [f"merge {box} {wall}"], "the command arrives")
    annotation = Annotation(result)
    annotation.merge(box, wall)
    page.board.show(shown(annotation.result))
    page.board.tell(replace(STATE, corrections="1 correction", said="merged"))
    browser.wait_for("picture.places.length === 1")
    browser.wait_for("document.getElementById('said').textContent === 'merged'")
    assert browser.evaluate("[...chosen]") == []
    assert corrector.usable() == ["Undo", "Save"]
    corrector.press("Undo")
    corrector.press("Save")
    corrector.click(*WALL)
    corrector.press("Split")
    corrector.press("Split all")
    wait_until(lambda: len(page.asked) == 5, "the commands arrive")
    assert page.asked[1:] == ["undo", "save", f"split {box}", f"split {box} all"]
    # A second click takes it back.
    corrector.click(*WALL)
    assert browser.evaluate("[...chosen]") == []
    corrector.press("Correct")
    assert browser.evaluate("canvas.getBoundingClientRect().width") == 0
    assert browser.errors == []


def test_a_run_is_paused_for_corrections(page: Any, corrector: Corrector) -> None:
    page.board.tell(replace(STATE, paused=False))
    corrector.browser.wait_for("newest.values.Pause === false")
    corrector.press("Correct")
    wait_until(lambda: page.asked == ["pause"], "the command arrives")
    assert corrector.usable() == []


class SlowScript:
    """The files of the page, of which the script for corrections comes late."""

    def __truediv__(self, name: str) -> Path:
        time.sleep(2.0 if name == "correct.js" else 0.0)
        return Path(server.__file__).parent / name


def test_the_first_state_is_known_however_late_the_script_comes(
    page: Any, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "files", lambda _: SlowScript())
    page.board.tell(STATE)
    browser.open(f"{page.url}#{page.board.token}")
    browser.wait_for("newest.values.Pause === true", 8.0)


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_the_photo_and_its_buttons_fit_on_a_screen(
    page: Any, corrector: Corrector, width: int, height: int
) -> None:
    browser = corrector.browser
    size = {"width": width, "height": height, "deviceScaleFactor": 2, "mobile": width < 500}
    browser.call("Emulation.setDeviceMetricsOverride", **size)
    corrector.press("Correct")
    browser.wait_for("picture !== null && canvas.width > 300")
    elements = "[...document.querySelectorAll('canvas, nav button, footer button')]"
    boxes = f"{elements}.map(each => each.getBoundingClientRect())"
    found = browser.evaluate(f"{boxes}.map(({{x, y, width, height}}) => [x, y, width, height])")
    shown = [each for each in found if each[2] > 0]
    assert len(shown) >= 10
    for x, y, wide, high in shown:
        assert 0 <= x <= x + wide <= width
        assert 0 <= y <= y + high <= height
        assert high >= (44 if width < 500 else 30)
    viewer = browser.evaluate("document.getElementById('viewer').getBoundingClientRect().width")
    assert viewer == 0 if width < 500 else viewer > 400
    assert shown[0][2] > (350 if width < 500 else 500)
    corrector.click(*BOX)
    assert browser.evaluate("chosen.size") == 1
