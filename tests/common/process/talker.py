"""A program for the tests of the channel: does what it is told by pairs of a word and a number."""

from __future__ import annotations

import logging
import sys
import time

import numpy as np

from nurbseg.common.process.channel import ChannelClosedError, connect_to_parent, forward_log

SLOTS, SLOT_BYTES = 3, 1_000_000


def main() -> int:
    channel = connect_to_parent(limit_s=1.0)
    forward_log(channel, logging.INFO)
    put = 0
    try:
        while True:
            message = channel.receive(0.05)
            channel.beat()
            if isinstance(message, np.ndarray):
                channel.send(("got", int(message.sum())))
                continue
            word, count = message or ("", 0)
            if word == "log":
                logging.getLogger("nurbseg.talker").warning("a %s", "word")
            elif word == "spin":
                while True:
                    pass
            elif word == "hang":
                while True:
                    time.sleep(60.0)
            elif word == "ring":
                channel.begin_ring(SLOTS, SLOT_BYTES)
            elif word in ("put", "put newest", "put all"):
                done = 0
                for _ in range(count):
                    pixels = np.full((100, 400 * (1 + put % 10)), put, np.uint16)
                    pixels.flags.writeable = False
                    while not (is_put := channel.put((put, pixels), 0.0, overwrite=word == "put newest")):
                        if word == "put":
                            break
                    done += is_put
                    put += is_put
                channel.send(("put", done))
            elif word == "put late":
                time.sleep(1.0)
                channel.put((put, np.zeros(1)))
            elif word == "too large":
                try:
                    channel.put(np.zeros(2 * SLOT_BYTES, np.uint8))
                except ValueError as err:
                    channel.send(("refused", str(err)))
            elif word:
                channel.send((word, count))
    except ChannelClosedError:
        return 7


if __name__ == "__main__":
    sys.exit(main())
