"""Results as lines of JSON: on standard output, or for everyone who connects to a Unix socket."""

import json
import logging
import os
import selectors
import socket
import stat
import sys
from pathlib import Path

from nurbseg.app.errors import PublishError
from nurbseg.app.publish.published import published_document
from nurbseg.app.publish.publisher import Sink
from nurbseg.library.result import FrameResult

_log = logging.getLogger(__name__)

#: Listeners at once.
_LISTENERS_MAX = 16


def _line(result: FrameResult) -> bytes:
    return json.dumps(published_document(result), separators=(",", ":")).encode() + b"\n"


class StandardOutput(Sink):
    """Writes a line per frame to standard output; ends when nobody reads it any more."""

    name = "standard output"

    def publish(self, result: FrameResult) -> None:
        """Write the line of a frame."""
        try:
            rest = _line(result)
            while rest:
                # Unbuffered: whoever flushes the buffer at the end would wait for a reader that has stopped.
                rest = rest[os.write(sys.stdout.fileno(), rest) :]
        except OSError as err:
            # Python would fail again at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            is_gone = isinstance(err, BrokenPipeError)
            what = "nobody reads the lines any more" if is_gone else err.strerror or str(err)
            raise PublishError(f"standard output: {what}") from err

    def close(self) -> None:
        """Do nothing: standard output is not ours."""


class SocketLines(Sink):
    """Sends a line per frame to everyone who is connected to a Unix socket, which only this user may open.

    A listener that is slow gets whole lines, but not all.

    Raises PublishError if the socket cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path
        #: What a listener has not taken yet of the line that was sent to it last.
        self._listeners: dict[socket.socket, bytes] = {}
        self._server = socket.socket(socket.AF_UNIX)
        self._server.setblocking(False)
        try:
            _remove_stale(path)
            before = os.umask(0o177)
            try:
                self._server.bind(str(path))
            finally:
                os.umask(before)
            self._server.listen(_LISTENERS_MAX)
        except OSError as err:
            self._server.close()
            raise PublishError(f"{path}: cannot listen there: {err.strerror or err}") from err

    def publish(self, result: FrameResult) -> None:
        """Send the line of a frame to those who have taken the one before."""
        self._accept()
        if not self._listeners:
            return
        line = _line(result)
        for listener, rest in list(self._listeners.items()):
            try:
                rest = rest[listener.send(rest) :] if rest else rest
                if not rest:
                    rest = line[listener.send(line) :]
            except BlockingIOError:
                pass
            except OSError:
                listener.close()
                del self._listeners[listener]
                continue
            self._listeners[listener] = rest

    def _accept(self) -> None:
        while len(self._listeners) < _LISTENERS_MAX:
            try:
                listener, _ = self._server.accept()
            except BlockingIOError:
                return
            listener.setblocking(False)
            self._listeners[listener] = b""

    def close(self) -> None:
        """Close the connections, after what is left of their last lines, and remove the socket."""
        with selectors.DefaultSelector() as waiting:
            for listener, rest in self._listeners.items():
                if rest:
                    waiting.register(listener, selectors.EVENT_WRITE, rest)
            for key, _ in waiting.select(timeout=0.2):
                try:
                    key.fileobj.send(key.data)  # type: ignore[union-attr]
                except OSError:
                    _log.debug("a listener is gone")
        for listener in self._listeners:
            listener.close()
        self._server.close()
        self._path.unlink(missing_ok=True)


def _remove_stale(path: Path) -> None:
    """Remove the socket of a run that was killed; raises OSError if something else is there, or a run."""
    try:
        is_socket = stat.S_ISSOCK(path.lstat().st_mode)
    except FileNotFoundError:
        return
    if not is_socket:
        raise FileExistsError(0, "something else has this name")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
        else:
            raise FileExistsError(0, "another run publishes there")
