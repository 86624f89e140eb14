"""A client of a WebSocket (RFC 6455) and of Foxglove's protocol on it, by sockets alone."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterator
from typing import Any


class FoxgloveClient:
    """Connects to a server on this computer; every wait ends after ten seconds."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=10)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._socket.recv(4096)
        head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        assert b" 101 " in head.splitlines()[0], head
        self.channels: dict[str, dict[str, Any]] = {}

    def send(self, message: dict[str, Any]) -> None:
        """Send a message of JSON, masked as clients must."""
        content, mask = json.dumps(message).encode(), os.urandom(4)
        size = (
            bytes([0x80 | len(content)]) if len(content) < 126 else b"\xfe" + struct.pack(">H", len(content))
        )
        body = bytes(byte ^ mask[n % 4] for n, byte in enumerate(content))
        self._socket.sendall(b"\x81" + size + mask + body)

    def messages(self) -> Iterator[dict[str, Any] | tuple[str, int, bytes]]:
        """Yield messages: of JSON, or the topic, time and content of one of data."""
        while True:
            first, second = self._take(2)
            size = second & 0x7F
            if size > 125:
                size = struct.unpack(">H" if size == 126 else ">Q", self._take(2 if size == 126 else 8))[0]
            content = self._take(size)
            if first & 0x0F == 1:
                message = json.loads(content)
                if message["op"] == "advertise":
                    self.channels |= {channel["topic"]: channel for channel in message["channels"]}
                yield message
            elif first & 0x0F == 2 and content[0] == 1:
                subscription, log_ns = struct.unpack("<IQ", content[1:13])
                yield self._topics[subscription], log_ns, content[13:]

    def subscribe(self, *topics: str) -> None:
        """Ask for the messages of topics."""
        self._topics = dict(enumerate(topics))
        wanted = [{"id": n, "channelId": self.channels[topic]["id"]} for n, topic in self._topics.items()]
        self.send({"op": "subscribe", "subscriptions": wanted})

    def _take(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._buffer += (got := self._socket.recv(1 << 20))
            if not got:
                raise EOFError("the server closed the connection")
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
