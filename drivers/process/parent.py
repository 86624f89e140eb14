"""The connection to the process that started this one."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time

from nurbseg.drivers.process.channel import Channel
from nurbseg.drivers.process.messages import Codec


def connect(codec: Codec, *, limit_s: float) -> Channel:
    """Return the channel to the process that started this one; for programs that `ChildProcess` runs.

    When that process has finished or died, the channel raises ChannelClosedError, and this process should
    end. Where it hangs instead for longer than the limit, it is ended.
    """
    descriptor, memory, slots = map(int, sys.argv[1:4])
    channel = Channel(socket.socket(fileno=descriptor), memory, slots, codec)

    def end_with_parent() -> None:
        channel.wait_finished()
        time.sleep(limit_s)
        os._exit(1)

    # A daemon: it ends with the process, or ends it.
    threading.Thread(target=end_with_parent, name="parent", daemon=True).start()
    return channel
