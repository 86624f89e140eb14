"""A program for the tests of the channel: does what it is told."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import EndOfRecordingError
from nurbseg.common.process.channel import ChannelClosedError, LogForwarder, connect_to_parent
from nurbseg.common.process.codec import Call, Codec


@dataclass(frozen=True)
class Say:
    what: str
    count: int = 1


@dataclass(frozen=True, eq=False)
class Picture:
    number: int
    pixels: NDArray[np.uint16]


CODEC = Codec(Say, Picture)


def product(one: int, other: int) -> int:
    return one * other


def pictures(count: int) -> Iterator[Picture]:
    """So many pictures, and then an error if it is a round number."""
    for number in range(count):
        yield Picture(number, np.full((100, 100), number, np.uint16))
    if count % 10 == 0:
        raise EndOfRecordingError(f"{count} pictures")


FUNCTIONS = {"product": product, "pictures": pictures, "sleep": time.sleep}


def main() -> int:
    channel = connect_to_parent(CODEC, limit_s=1.0)
    logging.basicConfig(level=logging.INFO, handlers=[LogForwarder(channel)])
    try:
        while True:
            message = channel.receive(0.05)
            channel.beat()
            if isinstance(message, Call):
                channel.answer(message, FUNCTIONS)
            elif isinstance(message, Picture):
                channel.send(Say("got", int(message.pixels.sum())))
            elif isinstance(message, Say) and message.what == "log":
                logging.getLogger("nurbseg.talker").warning("a %s", "word")
            elif isinstance(message, Say) and message.what == "hang":
                while True:
                    time.sleep(60.0)
            elif isinstance(message, Say) and message.what in ("send", "send all"):
                sent = 0
                for number in range(message.count):
                    picture = Picture(number, np.full((100, 100 * (number + 1)), number, np.uint16))
                    while not (done := channel.send(picture, 0.0)) and message.what == "send all":
                        channel.receive(5.0)
                    sent += done
                channel.send(Say("sent", sent))
            elif isinstance(message, Say):
                channel.send(message)
    except ChannelClosedError:
        return 7


if __name__ == "__main__":
    sys.exit(main())
