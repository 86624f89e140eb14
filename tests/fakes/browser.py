"""A Chromium without a screen, driven through its debugging pipe; every wait for it has a limit."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

#: The descriptors that Chromium reads commands from, and writes answers to.
_COMMANDS, _ANSWERS = 3, 4


class Browser:
    """One page, and the errors of its programs; skips the test where there is no Chromium."""

    def __init__(self, profile: Path, width: int = 1280, height: int = 800, rules: str = "") -> None:
        chromium = shutil.which("chromium")
        if chromium is None:
            pytest.skip("no Chromium to open the page with: install chromium")
        reads, self._commands = os.pipe()
        self._answers, writes = os.pipe()
        words = [
            *(chromium, "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--no-first-run"),
            *("--enable-unsafe-swiftshader", f"--user-data-dir={profile}", "--remote-debugging-pipe"),
            f"--window-size={width},{height}",
            f"--host-resolver-rules={rules}",
        ]
        # A shell places the pipes: code between fork and exec may hang in a program with threads.
        place = f'exec "$@" {_COMMANDS}<&{reads} {_ANSWERS}>&{writes}'
        self._process = subprocess.Popen(
            ["bash", "-c", place, "bash", *words],
            pass_fds=(reads, writes),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(reads)
        os.close(writes)
        self._number = 0
        self._buffer = b""
        self._session: str | None = None
        self.errors: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")
        self.call("Runtime.enable")

    def open(self, url: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=url)

    def screenshot(self) -> bytes:
        """Return a picture of the page, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def evaluate(self, code: str) -> Any:
        """Return the value of JavaScript in the page; of a promise, what it resolves to."""
        answer = self.call("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, code: str, limit_s: float = 90.0) -> None:
        """Return once a condition holds in the page, which may still be loading."""
        condition = f"(() => {{ try {{ return !!({code}); }} catch {{ return false; }} }})()"
        deadline_s = time.monotonic() + limit_s
        while not self.evaluate(condition):
            assert time.monotonic() < deadline_s, f"never true: {code}"
            time.sleep(0.05)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Return the answer to a command of the DevTools protocol."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(str(answer["params"]))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def _next(self, limit_s: float = 90.0) -> dict[str, Any]:
        deadline_s = time.monotonic() + limit_s
        while b"\0" not in self._buffer:
            left_s = max(0.0, deadline_s - time.monotonic())
            assert select.select([self._answers], [], [], left_s)[0], "the browser does not answer"
            part = os.read(self._answers, 1 << 16)
            assert part, "the browser has ended"
            self._buffer += part
        text, _, self._buffer = self._buffer.partition(b"\0")
        answer: dict[str, Any] = json.loads(text)
        return answer

    def close(self) -> None:
        """End the browser."""
        self._process.terminate()
        try:
            self._process.wait(20.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(20.0)
        os.close(self._commands)
        os.close(self._answers)


__all__ = ["Browser"]
