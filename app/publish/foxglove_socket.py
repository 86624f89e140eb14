"""A WebSocket server in Foxglove's protocol, for those who know the token in its address.

The SDK's own server accepts every client from every page, and offers no way to refuse one.
"""

import json
import secrets
import struct
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

from nurbseg.common.process.bounded_queue import BoundedQueue

_PROTOCOLS: list[Any] = ["foxglove.sdk.v1", "foxglove.websocket.v1"]
#: Listeners at once, and frames that wait for one, who gets only the newest of more.
_LISTENERS_MAX, _FRAMES_MAX = 16, 2
#: Longest message of a listener, bytes; longest wait for the server's thread to end, seconds.
_MESSAGE_BYTES_MAX, _CLOSE_S = 1 << 16, 2.0
#: Kind, subscription and time of a message with data.
_DATA = struct.Struct("<BIQ")

Parameters = Callable[[list[str]], dict[str, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    log_ns: int
    contents: Mapping[int, bytes]


@dataclass(frozen=True, slots=True, eq=False)
class _Listener:
    connection: Any
    queue: BoundedQueue[_Frame | str]
    #: The listener's number for each channel that it wants.
    subscriptions: dict[int, int] = field(default_factory=dict)


class FoxgloveSocket:
    """Sends messages of fixed channels to all listeners, each in threads of its own.

    Parameters
    ----------
    host, port : str, int
        Where it listens.
    channels : sequence of dict
        The channels, as Foxglove's protocol advertises them.
    parameters : callable
        Returns the values of the named parameters, of all if none is named.
    change : callable
        Is given the name and the value of a parameter that a listener sets.

    Attributes
    ----------
    address : str
        What to open in Foxglove.

    Raises
    ------
    ImportError
        If the package websockets is missing.
    OSError
        If it cannot listen there.
    """

    def __init__(
        self,
        host: str,
        port: int,
        channels: list[dict[str, Any]],
        parameters: Parameters,
        change: Callable[[str, Any], None],
    ) -> None:
        from websockets.sync.server import serve

        self._channels, self._parameters, self._change = channels, parameters, change
        self._listeners: set[_Listener] = set()
        self._lock = threading.Lock()
        self._path = f"/{secrets.token_urlsafe(16)}"
        self._server = serve(
            self._serve,
            host,
            port,
            subprotocols=_PROTOCOLS,
            process_request=self._refusal,
            compression=None,
            max_size=_MESSAGE_BYTES_MAX,
        )
        self.address = f"ws://{f'[{host}]' if ':' in host else host}:{port}{self._path}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="foxglove", daemon=True)
        self._thread.start()

    def publish(self, contents: Mapping[int, bytes], log_ns: int) -> None:
        """Send the messages of a frame, by channel, soon."""
        for listener in self._all():
            listener.queue.put(_Frame(log_ns, contents))

    def publish_parameters(self) -> None:
        """Send the values of all parameters soon."""
        for listener in self._all():
            listener.queue.put_urgent(self._values([], None))

    def close(self) -> None:
        """End all connections and the server."""
        self._server.shutdown()
        for listener in self._all():
            listener.queue.close()
            listener.connection.socket.close()
        self._thread.join(_CLOSE_S)

    def _all(self) -> list[_Listener]:
        with self._lock:
            return list(self._listeners)

    def _refusal(self, connection: Any, request: Any) -> Any:
        """Return the refusal of a listener without the token, or of one too many; None for others."""
        if not secrets.compare_digest(request.path.encode(), self._path.encode()):
            return connection.respond(HTTPStatus.FORBIDDEN, "open the address that nurbseg-live has logged\n")
        if len(self._all()) >= _LISTENERS_MAX:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "there are too many listeners\n")
        return None

    def _serve(self, connection: Any) -> None:
        """Answer one listener until it is gone; another thread sends what is published."""
        listener = _Listener(connection, BoundedQueue(_FRAMES_MAX, "drop oldest"))
        info = {"op": "serverInfo", "name": "nurbseg", "capabilities": ["parameters"], "metadata": {}}
        listener.queue.put_urgent(json.dumps(info))
        listener.queue.put_urgent(json.dumps({"op": "advertise", "channels": self._channels}))
        sending = threading.Thread(target=_send, args=[listener], name="foxglove-send", daemon=True)
        sending.start()
        with self._lock:
            self._listeners.add(listener)
        try:
            for message in connection:
                self._answer(listener, message)
        finally:
            with self._lock:
                self._listeners.discard(listener)
            listener.queue.discard()

    def _answer(self, listener: _Listener, message: str | bytes) -> None:
        """Do what a listener asks for; what is not of the protocol is ignored."""
        try:
            asked = json.loads(message)
            if asked["op"] == "subscribe":
                listener.subscriptions.update(
                    {int(each["channelId"]): int(each["id"]) for each in asked["subscriptions"]}
                )
            elif asked["op"] == "unsubscribe":
                for channel, subscription in list(listener.subscriptions.items()):
                    if subscription in asked["subscriptionIds"]:
                        del listener.subscriptions[channel]
            elif asked["op"] == "getParameters":
                listener.queue.put_urgent(self._values(asked["parameterNames"], asked.get("id")))
            elif asked["op"] == "setParameters":
                for parameter in asked["parameters"]:
                    self._change(parameter["name"], parameter["value"])
        except (ValueError, TypeError, KeyError, RecursionError):
            return

    def _values(self, names: list[str], number: str | None) -> str:
        """Return a message with the values of parameters, as the answer to a request if it has a number."""
        values = [{"name": name, "value": value} for name, value in self._parameters(names).items()]
        return json.dumps(
            {"op": "parameterValues", "parameters": values} | ({} if number is None else {"id": number})
        )


def _send(listener: _Listener) -> None:
    """Send what waits for a listener until the queue is closed or the listener is gone."""
    from websockets.exceptions import ConnectionClosed

    try:
        for item in listener.queue:
            if isinstance(item, str):
                listener.connection.send(item)
                continue
            for channel, content in item.contents.items():
                if (number := listener.subscriptions.get(channel)) is not None:
                    listener.connection.send(_DATA.pack(1, number, item.log_ns) + content)
    except (ConnectionClosed, OSError, struct.error):
        listener.queue.discard()
