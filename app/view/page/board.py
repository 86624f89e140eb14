"""What the page and the run tell each other."""

import json
import secrets
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nurbseg.app.control.commands import COMMANDS, RunState, recording_text, widget_values


class Board:
    """Holds the newest state of a run for browsers, and passes their commands on to it.

    `token` is what those who may see and control it know; nobody learns it from the page. `viewer_key` is
    what their browsers show to the viewer's port, as a cookie.
    """

    def __init__(self, ask: Callable[[str, int], object]) -> None:
        self._ask = ask
        self._asking = threading.Lock()
        self._asked = 0
        self.token, self.viewer_key = secrets.token_urlsafe(16), secrets.token_urlsafe(16)
        self._changed = threading.Condition()
        self._state: RunState | None = None
        self._version = 0

    def knows(self, token: str) -> bool:
        """Whether somebody has the token."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def ask(self, command: str) -> int:
        """Pass a command on to the run; return its number, which a state names once it was answered."""
        with self._asking:
            self._asked += 1
            self._ask(command, self._asked)
            return self._asked

    def tell(self, state: RunState) -> None:
        """Show a state."""
        with self._changed:
            self._state = state
            self._version += 1
            self._changed.notify_all()

    def explanation(self) -> bytes:
        """Return the page of the newest explanation; raises OSError if there is none any more."""
        return Path("" if self._state is None else self._state.explained).read_bytes()

    def wait(self, after: int, limit_s: float) -> bytes:
        """Return the newest state as JSON, once there is one with a higher number, or the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._version > after, limit_s)
            state, version = self._state, self._version
        if state is None:
            return json.dumps({"version": 0}).encode()
        recording = state.recording
        document: dict[str, Any] = {
            "version": version,
            "status": state.status,
            "said": state.said,
            "refused": state.refused,
            "answered": state.answered,
            "explained": state.explained,
            "ended": state.ended,
            "recording": "" if recording is None else recording_text(recording, brief=True),
            "values": widget_values(state),
        }
        if after == 0:
            document["widgets"] = _widgets()
        return json.dumps(document).encode()


def _widgets() -> list[dict[str, Any]]:
    """Return the widgets of all commands, with the command, its help and its keys as their tooltip."""
    widgets = []
    for command in COMMANDS:
        if command.widget is not None:
            title = f"{command.line}: {command.text} [{command.key_names}]"
            widgets.append(asdict(command.widget) | {"title": title})
    return widgets
