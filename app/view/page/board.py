"""What the page and the run tell each other."""

import base64
import json
import secrets
import threading
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np

from nurbseg.app.control.commands import COMMANDS, Asked, RunState, widget_values
from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.library.palette import label_color


class Board:
    """Holds the newest state of a run for browsers, and passes their commands on to it.

    `token` is what those who may see and control it know; nobody learns it from the page. `viewer_key` is
    what their browsers show to the viewer's port, as a cookie.
    """

    def __init__(self, ask: Callable[[Asked], object]) -> None:
        self._ask = ask
        self._asking = threading.Lock()
        self._asked = 0
        self.token, self.viewer_key = secrets.token_urlsafe(16), secrets.token_urlsafe(16)
        self._changed = threading.Condition()
        self._state: RunState | None = None
        self._version = 0
        self._frame: ViewFrame | None = None
        self._shown = 0

    def knows(self, token: str) -> bool:
        """Whether somebody has the token."""
        return secrets.compare_digest(token.encode(), self.token.encode())

    def ask(self, command: str) -> int:
        """Pass a command on to the run; return its number, which a state names once it was answered."""
        with self._asking:
            self._asked += 1
            self._ask(Asked(command, self._asked))
            return self._asked

    def tell(self, state: RunState) -> None:
        """Show a state."""
        with self._changed:
            self._state = state
            self._version += 1
            self._changed.notify_all()

    def show(self, frame: ViewFrame) -> None:
        """Show a frame; in a pause, when it may have been corrected, at once."""
        with self._changed:
            self._frame = frame
            self._shown += 1
            if self._state is not None and self._state.paused:
                self._version += 1
                self._changed.notify_all()

    def objects(self) -> bytes:
        """Return the newest frame as JSON: its photo, and its objects, row by row as runs of labels."""
        frame = self._frame
        if frame is None:
            return b"{}"
        labels = frame.surfaces if frame.objects is None else frame.objects
        ends = np.append(np.flatnonzero(np.diff(labels.ravel())), labels.size - 1)
        runs = np.stack([labels.ravel()[ends], np.diff(ends, prepend=-1)], axis=1)
        _, photo = cv2.imencode(".jpg", cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
        document = {
            "width": labels.shape[1],
            "height": labels.shape[0],
            "photo": base64.b64encode(photo.tobytes()).decode(),
            "runs": runs.ravel().tolist(),
            "colors": {label: label_color(label) for label in np.unique(labels).tolist()},
        }
        return json.dumps(document).encode()

    def wait(self, after: int, limit_s: float) -> bytes:
        """Return the newest state as JSON, once there is one with a higher number, or the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._version > after, limit_s)
            state, version, shown = self._state, self._version, self._shown
        if state is None:
            return json.dumps({"version": 0}).encode()
        recording = state.recording
        document: dict[str, Any] = {
            "version": version,
            "status": state.status,
            "said": state.said,
            "refused": state.refused,
            "answered": state.answered,
            "ended": state.ended,
            "recording": "" if recording is None else recording.brief,
            "corrections": state.corrections,
            "shown": shown,
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
