"""The other end of `nurbseg.drivers.openni2.oni.player`: starts it, and bounds every wait for it."""

import time
from pathlib import Path

from nurbseg.drivers.errors import RecordingFormatError
from nurbseg.drivers.openni2.isolated.messages import Failure
from nurbseg.drivers.openni2.oni.player import CODEC, Description, End, Play, PlayedImage
from nurbseg.drivers.process.channel import ChannelClosedError
from nurbseg.drivers.process.child import ChildProcess

#: The player must describe what it plays within this time, seconds; starting Python is most of it.
OPEN_LIMIT_S = 30.0
#: And must send an image within this time, seconds, or it hangs.
_HANG_LIMIT_S = 10.0
Message = Description | PlayedImage | Failure | End
#: Images that may wait.
_SLOTS = 4


class PlayerProcess:
    """The process that plays a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._process = ChildProcess("nurbseg.drivers.openni2.oni.player", slots=_SLOTS)
        self._channel = self._process.connect(CODEC)
        self._channel.send(Play(str(path.absolute())))

    def receive(self, timeout_s: float, limit_s: float | None = None) -> Message | None:
        """Return the next message, or None if it does not come in time.

        Raises RecordingFormatError if the player has died, or has sent nothing for `limit_s`.
        """
        deadline = time.monotonic() + timeout_s
        try:
            while True:
                left_s = deadline - time.monotonic()
                message: Message | None = self._channel.receive(max(0.0, left_s))
                if message is not None:
                    return message
                if self._channel.silent_s >= (_HANG_LIMIT_S if limit_s is None else limit_s):
                    raise RecordingFormatError(
                        f"{self._path}: OpenNI2's file driver hangs on it; the file is damaged"
                    )
                if left_s <= 0:
                    return None
        except ChannelClosedError:
            code = self._process.end(OPEN_LIMIT_S)
            raise RecordingFormatError(
                f"{self._path}: OpenNI2's file driver stopped with code {code}; the file is damaged"
            ) from None

    def close(self) -> None:
        """End the process."""
        self._process.close()
