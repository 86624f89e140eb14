"""Two processes and the channel between them: what gets through, and how one ends without the other."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
from own_children import own_children

from nurbseg.common.errors import DriverError, EndOfRecordingError
from nurbseg.common.process.channel import Channel, ChannelClosedError
from nurbseg.common.process.child import ChildProcess
from nurbseg.common.process.codec import Call
from tests.common.process.talker import CODEC, Picture, Say

TALKER = "tests.common.process.talker"
SLOTS = 3


class Talk:
    def __init__(self) -> None:
        self.process = ChildProcess(TALKER, slots=SLOTS)
        self.channel: Channel = self.process.connect(CODEC)
        (self.there,) = own_children()

    def hear(self, limit_s: float = 60.0) -> Any:
        deadline_s = time.monotonic() + limit_s
        while time.monotonic() < deadline_s:
            if (message := self.channel.receive(0.5)) is not None:
                return message
        raise AssertionError("heard nothing")

    def ask(self, message: Any) -> Any:
        assert self.channel.send(message)
        return self.hear()


@pytest.fixture
def talk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Talk]:
    # The program is one of the tests, which are not installed.
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    talk = Talk()
    yield talk
    talk.process.close()


def test_messages_go_to_and_fro_and_the_log_is_forwarded(
    talk: Talk, caplog: pytest.LogCaptureFixture
) -> None:
    assert talk.ask(Say("ä", 2**60)) == Say("ä", 2**60)
    talk.channel.send(Say("log"))
    assert talk.ask(Say("b")) == Say("b")
    assert [(record.name, record.levelno, record.getMessage()) for record in caplog.records] == [
        ("nurbseg.talker", logging.WARNING, "a word")
    ]


def test_arrays_of_any_size_get_through_one_after_the_other(talk: Talk) -> None:
    for number, shape in enumerate([(3, 5), (480, 640), (10, 10), (3000, 1000), (480, 640)] * 2):
        pixels = np.full(shape, 1 + number, dtype=np.uint16)
        assert talk.ask(Picture(number, pixels)) == Say("got", int(pixels.sum()))


def test_arrays_that_wait_are_not_written_over_and_beyond_the_slots_none_is_sent(talk: Talk) -> None:
    talk.channel.send(Say("send", SLOTS + 2))
    # Slots come free when they are taken: not before the program has tried to send all.
    time.sleep(3.0)
    heard = [talk.hear() for _ in range(SLOTS + 1)]
    assert heard[-1] == Say("sent", SLOTS)
    for number, picture in enumerate(heard[:-1]):
        assert picture.number == number
        assert picture.pixels.shape == (100, 100 * (number + 1))
        assert (picture.pixels == number).all()


def test_slots_come_free_again(talk: Talk) -> None:
    talk.channel.send(Say("send all", 20))
    heard = [talk.hear() for _ in range(21)]
    assert heard[-1] == Say("sent", 20)
    assert [each.number for each in heard[:-1]] == list(range(20))


def test_a_function_of_the_program_returns_its_value(talk: Talk) -> None:
    assert talk.channel.call("product", 6, 7, limit_s=60.0) == 42
    assert talk.channel.call("product", 2, 3, limit_s=60.0) == 6


@pytest.mark.parametrize("count", [2 * SLOTS + 1, 10])
def test_an_iterator_is_sent_item_by_item_and_then_its_end_or_its_error(talk: Talk, count: int) -> None:
    talk.channel.send(Call("pictures", (count,)))
    # The program waits for room: nothing is left out.
    time.sleep(1.0)
    for number in range(count):
        answer = talk.hear()
        assert (answer.function, answer.raised) == ("pictures", None)
        assert answer.value.number == number
        assert (answer.value.pixels == number).all()
    last = talk.hear()
    if count % 10:
        assert last.result() is None
    else:
        with pytest.raises(EndOfRecordingError, match=r"^10 pictures$"):
            last.result()


def test_the_error_of_a_function_is_raised_by_its_call(talk: Talk) -> None:
    with pytest.raises(DriverError) as raised:
        talk.channel.call("pictures", 0, limit_s=60.0)
    assert type(raised.value) is EndOfRecordingError
    assert str(raised.value) == "0 pictures"


def test_a_call_without_an_answer_ends_in_time_and_with_the_process(talk: Talk) -> None:
    with pytest.raises(TimeoutError, match=r"no answer within 0\.5 s"):
        talk.channel.call("sleep", 60.0, limit_s=0.5)
    talk.there.kill()
    with pytest.raises(ChannelClosedError):
        talk.channel.call("product", 6, 7, limit_s=60.0)


def test_a_silent_program_is_distinguished_from_one_that_hangs(talk: Talk) -> None:
    assert talk.ask(Say("a")) == Say("a")
    for _ in range(8):
        assert talk.channel.receive(0.5) is None
    assert talk.channel.silent_s < 3.0
    talk.channel.send(Say("hang"))
    began_s = time.monotonic()
    while talk.channel.silent_s < 4.0:
        assert time.monotonic() < began_s + 30.0
        talk.channel.receive(0.5)


def test_a_killed_process_closes_the_channel_after_its_last_words(talk: Talk) -> None:
    assert talk.ask(Say("a")) == Say("a")
    talk.channel.send(Say("b"))
    time.sleep(1.0)
    talk.there.kill()
    assert talk.hear() == Say("b")
    with pytest.raises(ChannelClosedError):
        talk.hear()
    with pytest.raises(ChannelClosedError):
        while True:
            talk.channel.send(Say("c"))
    assert talk.process.end(5.0) == -signal.SIGKILL


def test_what_waits_for_a_slot_learns_that_the_process_is_gone(talk: Talk) -> None:
    talk.channel.send(Say("hang"))
    picture = Picture(0, np.zeros((100, 100), np.uint16))
    assert [talk.channel.send(picture, 0.1) for _ in range(SLOTS + 1)] == [True] * SLOTS + [False]
    talk.there.kill()
    with pytest.raises(ChannelClosedError):
        talk.hear()
    with pytest.raises(ChannelClosedError):
        talk.channel.send(picture, 10.0)


def test_sending_to_a_stopped_process_ends_in_time(talk: Talk) -> None:
    assert talk.ask(Say("a")) == Say("a")
    talk.there.suspend()
    began_s = time.monotonic()
    for _ in range(100_000):
        if not talk.channel.send(Say("b"), 0.1):
            break
    else:
        pytest.fail("a socket took everything")
    assert time.monotonic() < began_s + 30.0
    talk.there.resume()
    assert talk.hear() == Say("b")


def test_a_process_ends_on_request(talk: Talk) -> None:
    assert talk.ask(Say("a")) == Say("a")
    talk.channel.finish()
    assert talk.process.end(30.0) == 7


def test_a_process_that_hangs_ends_all_the_same(talk: Talk) -> None:
    talk.channel.send(Say("hang"))
    time.sleep(1.0)
    talk.channel.finish()
    assert talk.process.end(30.0) == 1


def test_closing_ends_everything_and_leaves_nothing_open(talk: Talk) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    other = ChildProcess(TALKER, slots=1)
    other.close()
    other.close()
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    talk.process.close()
    assert own_children() == []


_PARENT = """
    import os, sys, time
    from nurbseg.common.process.child import ChildProcess
    from tests.common.process.talker import CODEC, Say
    process = ChildProcess("tests.common.process.talker", slots=1)
    channel = process.connect(CODEC)
    channel.send(Say("hang" if sys.argv[1] == "hang" else "a"))
    if sys.argv[1] == "answer":
        channel.receive(60.0)
    print("ready", flush=True)
    time.sleep(300)
"""


@pytest.mark.parametrize("what", ["answer", "hang"])
def test_a_process_ends_with_the_one_that_started_it_even_if_it_hangs(what: str) -> None:
    root = Path(__file__).parents[3]
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(_PARENT), what],
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "ready\n"
        (child,) = psutil.Process(parent.pid).children()
        parent.kill()
        child.wait(60.0)


def test_a_heartbeat_is_sent_each_second_however_often_the_loop_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now_s=1000.0)
    monkeypatch.setattr("nurbseg.common.process.channel.time", SimpleNamespace(monotonic=lambda: clock.now_s))
    near, far = socket.socketpair()
    sent = []
    with far:
        far.setblocking(False)
        channel = Channel(near, os.memfd_create("memory"), SLOTS, CODEC)
        for clock.now_s in (1000.0, 1000.1, 1000.9, 1001.1, 1001.2, 1003.0, 1003.0):
            channel.beat()
            try:
                sent.append(len(far.recv(1000)) > 0)
            except BlockingIOError:
                sent.append(False)
        channel.close()
    assert sent == [True, False, False, True, False, True, False]
