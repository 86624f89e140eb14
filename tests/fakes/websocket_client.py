"""A client of Foxglove's protocol, on an independent WebSocket library."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

from websockets.sync.client import connect


class FoxgloveClient:
    """Listens at an address; `channels` are those that were advertised, by topic."""

    def __init__(self, address: str, **headers: str) -> None:
        options: dict[str, Any] = {"subprotocols": ["foxglove.sdk.v1"], "additional_headers": headers}
        # Some versions are to be entered, not just called.
        self._connection = connect(address, max_size=None, **options).__enter__()
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}

    def send(self, message: dict[str, Any]) -> None:
        """Send a message of JSON."""
        self._connection.send(json.dumps(message))

    def messages(self) -> Iterator[dict[str, Any] | tuple[str, int, bytes]]:
        """Yield messages: of JSON, or the topic, time and content of one of data."""
        while True:
            content = self._connection.recv(timeout=30.0)
            if isinstance(content, str):
                message = json.loads(content)
                if message["op"] == "advertise":
                    self.channels |= {channel["topic"]: channel for channel in message["channels"]}
                yield message
            elif content[0] == 1:
                subscription, log_ns = struct.unpack("<IQ", content[1:13])
                yield self._topics[subscription], log_ns, content[13:]

    def subscribe(self, *topics: str) -> None:
        """Ask for the messages of topics."""
        self._topics = dict(enumerate(topics))
        wanted = [{"id": n, "channelId": self.channels[topic]["id"]} for n, topic in self._topics.items()]
        self.send({"op": "subscribe", "subscriptions": wanted})

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()
