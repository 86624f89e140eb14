"""Two processes and the channel between them: what gets through, and how one ends without the other."""

from __future__ import annotations

import copyreg
import logging
import mmap
import os
import pickle
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from own_children import own_children

from nurbseg.common.process.channel import Channel, ChannelClosedError, Items
from nurbseg.common.process.child import ChildProcess, python_command
from nurbseg.common.process.codec import decode
from nurbseg.drivers.openni2.capi import PixelFormat
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from tests.common.process.talker import SLOT_BYTES, SLOTS

TALKER = "tests.common.process.talker"


class Talk:
    def __init__(self) -> None:
        self.process = ChildProcess(TALKER, quiet=False)
        self.channel: Channel = self.process.channel
        (self.there,) = own_children()

    def hear(self, items: Items = "next") -> Any:
        deadline_s = time.monotonic() + 60.0
        while time.monotonic() < deadline_s:
            if (message := self.channel.receive(0.5, items)) is not None:
                return message
        raise AssertionError("heard nothing")

    def ask(self, message: Any) -> Any:
        assert self.channel.send(message)
        return self.hear("none")


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
    assert talk.ask(("ä", 2**60)) == ("ä", 2**60)
    talk.channel.send(("log", 0))
    assert talk.ask(("b", 1)) == ("b", 1)
    assert [(record.name, record.levelno, record.getMessage()) for record in caplog.records] == [
        ("nurbseg.talker", logging.WARNING, "a word")
    ]


def test_enumerations_paths_and_errors_get_through(talk: Talk, monkeypatch: pytest.MonkeyPatch) -> None:
    # As Dask's package tblib does for all errors.
    monkeypatch.setitem(copyreg.dispatch_table, FileExistsError, lambda err: (print, (str(err),)))
    sent = PixelFormat.RGB888, Path("/a/b"), SourceOptions(device=DeviceOptions(mirror=True))
    assert talk.ask(("a", sent)) == ("a", sent)
    _, error = talk.ask(("a", FileExistsError(17, "is there")))
    assert (type(error), error.errno, error.strerror) == (FileExistsError, 17, "is there")


def test_arrays_get_through_one_after_the_other(talk: Talk) -> None:
    talk.channel.begin_ring(SLOTS, 10_000_000)
    for number, shape in enumerate([(3, 5), (480, 640), (10, 10), (3000, 1000), (480, 640)] * 2):
        pixels = np.full(shape, 1 + number, dtype=np.uint16)
        assert talk.channel.put(pixels, 60.0)
        assert talk.hear() == ("got", int(pixels.sum()))


def items(talk: Talk, count: int) -> list[int]:
    """Take items, and return their numbers; each array holds its own."""
    numbers = []
    while len(numbers) < count:
        number, pixels = talk.hear()
        if number == "put":
            continue
        assert pixels.shape == (100, 400 * (1 + number % 10))
        assert (pixels == number).all()
        assert not pixels.flags.writeable
        numbers.append(number)
    return numbers


def test_beyond_the_slots_no_item_is_put_and_those_that_wait_are_not_written_over(talk: Talk) -> None:
    talk.channel.send(("ring", 0))
    assert talk.ask(("put", SLOTS + 2)) == ("put", SLOTS)
    assert items(talk, SLOTS) == list(range(SLOTS))
    assert talk.channel.receive(0.2) is None


def test_slots_come_free_again(talk: Talk) -> None:
    talk.channel.send(("ring", 0))
    talk.channel.send(("put all", 20))
    assert items(talk, 20) == list(range(20))


def test_newer_items_replace_the_oldest(talk: Talk) -> None:
    talk.channel.send(("ring", 0))
    assert talk.ask(("put newest", 20)) == ("put", 20)
    assert items(talk, SLOTS) == [17, 18, 19]
    assert talk.ask(("put newest", 5)) == ("put", 5)
    assert talk.channel.take("newest", peek=True)[0] == 24
    assert talk.channel.receive(0.2, "none") is None
    assert talk.channel.receive(5.0, "newest")[0] == 24
    assert talk.channel.skipped == 17 + 4
    assert talk.channel.receive(0.2, "newest") is None


def test_an_item_that_is_replaced_while_it_is_read_is_never_torn(talk: Talk) -> None:
    talk.channel.send(("ring", 0))
    talk.channel.send(("put newest", 3000))
    numbers, is_over = [], False
    while not is_over:
        number, pixels = talk.hear()
        if is_over := number == "put":
            continue
        assert (pixels == number).all()
        numbers.append(number)
    assert numbers == sorted(set(numbers))
    assert len(numbers) > 10


@pytest.mark.parametrize(("slots", "expected"), [(1, [None]), (2, [2])])
def test_an_item_that_is_being_replaced_is_not_waited_for(slots: int, expected: list[int | None]) -> None:
    # As if the process that puts it had been killed meanwhile.
    sockets = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    memory = os.memfd_create("ring")
    os.ftruncate(memory, mmap.PAGESIZE)
    with closing(Channel(sockets[0], memory)) as puts, closing(Channel(sockets[1], os.dup(memory))) as takes:
        puts.begin_ring(slots, 1000)
        seen = []

        class Meanwhile:
            def __reduce__(self) -> Any:
                seen.append(takes.take())
                return OSError, ("late",)

        for item in range(1, slots + 1):
            puts.put(item)
        puts.put(Meanwhile(), overwrite=True)
        assert seen == expected
        assert isinstance(takes.take(), OSError)


def test_an_item_wakes_who_waits_for_it(talk: Talk) -> None:
    talk.channel.send(("ring", 0))
    talk.channel.send(("put late", 0))
    began_s = time.monotonic()
    assert talk.channel.receive(20.0)[0] == 0
    assert time.monotonic() < began_s + 15.0


def test_an_item_larger_than_a_slot_is_refused(talk: Talk) -> None:
    talk.channel.send(("ring", 0))
    word, text = talk.ask(("too large", 0))
    assert word == "refused"
    assert "does not fit" in text
    with pytest.raises(ValueError, match="at most 100000"):
        talk.channel.send("x" * 200_000)


def test_nothing_but_messages_is_made_of_bytes() -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return os.system, ("true",)

    for evil in (Evil(), os.getcwd, subprocess.Popen, eval, ChildProcess, python_command):
        with pytest.raises(pickle.UnpicklingError, match="is no message"):
            decode(pickle.dumps(evil))


def test_a_silent_program_is_distinguished_from_one_that_hangs(talk: Talk) -> None:
    assert talk.ask(("a", 1)) == ("a", 1)
    for _ in range(8):
        assert talk.channel.receive(0.5) is None
    assert talk.channel.silent_s < 3.0
    talk.channel.send(("hang", 0))
    began_s = time.monotonic()
    while talk.channel.silent_s < 3.0:
        assert time.monotonic() < began_s + 30.0
        talk.channel.receive(0.5)


def test_a_killed_process_closes_the_channel_after_its_last_words(talk: Talk) -> None:
    assert talk.ask(("a", 1)) == ("a", 1)
    talk.channel.send(("b", 1))
    time.sleep(1.0)
    talk.there.kill()
    assert talk.hear() == ("b", 1)
    with pytest.raises(ChannelClosedError):
        talk.hear()
    with pytest.raises(ChannelClosedError):
        while True:
            talk.channel.send(("c", 1))
    assert talk.process.end(5.0) == -signal.SIGKILL


def test_what_waits_for_a_slot_learns_that_the_process_is_gone(talk: Talk) -> None:
    talk.channel.begin_ring(SLOTS, SLOT_BYTES)
    talk.channel.send(("hang", 0))
    time.sleep(1.0)
    pixels = np.zeros((100, 100), np.uint16)
    assert [talk.channel.put(pixels, 0.1) for _ in range(SLOTS + 1)] == [True] * SLOTS + [False]
    talk.there.kill()
    with pytest.raises(ChannelClosedError):
        talk.hear()
    with pytest.raises(ChannelClosedError):
        talk.channel.put(pixels, 10.0)


def test_sending_to_a_stopped_process_ends_in_time(talk: Talk) -> None:
    assert talk.ask(("a", 1)) == ("a", 1)
    talk.there.suspend()
    began_s = time.monotonic()
    for _ in range(100_000):
        if not talk.channel.send(("b", 1), 0.1):
            break
    else:
        pytest.fail("a socket took everything")
    assert time.monotonic() < began_s + 30.0
    talk.there.resume()
    assert talk.hear() == ("b", 1)


def test_a_process_ends_on_request(talk: Talk) -> None:
    assert talk.ask(("a", 1)) == ("a", 1)
    talk.channel.close()
    assert talk.process.end(30.0) == 7


def test_a_process_that_hangs_ends_all_the_same(talk: Talk) -> None:
    talk.channel.send(("hang", 0))
    time.sleep(1.0)
    talk.channel.close()
    assert talk.process.end(30.0) == 1


def test_closing_ends_everything_and_leaves_nothing_open(talk: Talk) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    other = ChildProcess(TALKER)
    other.close()
    other.close()
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    talk.process.close()
    assert own_children() == []


_PARENT = """
    import os, sys, time
    from nurbseg.common.process.child import ChildProcess
    process = ChildProcess("tests.common.process.talker")
    channel = process.channel
    channel.send(("hang" if sys.argv[1] == "hang" else "a", 1))
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


@pytest.mark.parametrize("how", ["hang", "spin", "stopped"])
def test_a_process_without_a_heartbeat_hangs_whatever_it_does(talk: Talk, how: str) -> None:
    assert talk.ask(("a", 1)) == ("a", 1)
    if how == "stopped":
        talk.there.suspend()
    else:
        talk.channel.send((how, 0))
    began_s = time.monotonic()
    while not talk.process.hangs(2.0):
        assert time.monotonic() < began_s + 60.0
        talk.channel.receive(0.1)
    assert time.monotonic() > began_s + 1.5


def test_a_process_that_had_no_core_does_not_hang(talk: Talk) -> None:
    assert talk.ask(("a", 1)) == ("a", 1)
    core = min(os.sched_getaffinity(0))
    # Each in a session of its own: Linux may share a core between sessions.
    hog = [sys.executable, "-c", _HOG, str(core)]
    hogs = [subprocess.Popen(hog, start_new_session=True) for _ in range(6)]
    try:
        talk.there.cpu_affinity([core])
        os.sched_setscheduler(talk.there.pid, os.SCHED_IDLE, os.sched_param(0))
        # It computes whenever it has a core, which it hardly ever has.
        talk.channel.send(("spin", 0))
        began_s = time.monotonic()
        while time.monotonic() < began_s + 4.0:
            assert not talk.process.hangs(2.0)
            talk.channel.receive(0.1)
    finally:
        for each in hogs:
            each.kill()
            each.wait()


_HOG = "import os, sys\nos.sched_setaffinity(0, [int(sys.argv[1])])\nwhile True: pass"
