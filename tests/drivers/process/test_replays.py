"""Recordings that a process of its own reads: the same frames as here, and what a bad one costs."""

import signal
import time

import pytest
from own_children import own_children
from rendered import rendered
from scripted_source import write_numbered

from nurbseg.common.errors import EndOfRecordingError, RecordingFormatError
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.process.client import SourceProcess
from nurbseg.drivers.process.messages import Playback, RecordOptions
from nurbseg.testing import SourceContract


@pytest.fixture(scope="module")
def numbered(tmp_path_factory):
    return str(write_numbered(tmp_path_factory.mktemp("replays") / "numbered.mcap", 30))


class TestContract(SourceContract):
    frames = 6

    def open(self):
        return SourceProcess(rendered("width=96&height=72&frames=6"))


def test_only_the_newest_frame_is_read_of_a_replay_at_its_own_rate(numbered):
    with SourceProcess(numbered, playback=Playback(speed=1.0, loop=True), every=False) as source:
        numbers = [source.read(30.0).index]
        while numbers[-1] < 70:
            source.wait(0.04)
            numbers.append(source.read(30.0).index)
        assert numbers == sorted(set(numbers))
        assert source.missed == numbers[-1] - numbers[0] + 1 - len(numbers)
        source.play(loop=False)
        with pytest.raises(EndOfRecordingError):
            while True:
                source.read(30.0)
        assert source.status.read == 90
        source.seek(12)
        assert source.read(30.0).index % 30 >= 12


@pytest.mark.parametrize("paused", [False, True])
def test_frames_that_wait_in_the_ring_when_another_one_is_sought_are_passed_over(numbered, paused):
    with SourceProcess(numbered) as source:
        assert source.read(30.0).index == 0
        for index in (20, 3, 3, 12):
            time.sleep(0.3)  # until the ring is full, and one more frame waits for room
            source.play(paused=paused)
            source.seek(index)
            assert source.read(30.0).index == index
            assert source.waits is paused
            source.play(paused=False)
            assert source.read(30.0).index == index + 1


def test_one_that_takes_more_memory_than_it_may_is_named(numbered):
    too_much = pytest.raises(RecordingFormatError, match=r"numbered\.mcap: reading it takes more than 500 MB")
    with too_much, SourceProcess(numbered, SourceOptions(memory_mb=500)) as source:
        source.read(30.0)
    assert not own_children()


def test_one_that_crashes_its_reader_is_named(numbered):
    with SourceProcess(numbered) as source:
        source.read(30.0)
        (process,) = own_children()
        process.send_signal(signal.SIGSEGV)
        with pytest.raises(RecordingFormatError, match=r"the source process ended by signal 11; the file"):
            while True:
                source.read(30.0)


def test_every_part_of_a_recording_is_named_however_many_there_are(tmp_path):
    numbered = write_numbered(tmp_path / "numbered.mcap", 130)
    with SourceProcess(str(numbered)) as source:
        # Frames come every 33 ms: each is a part.
        source.record(RecordOptions(tmp_path / "a.mcap", split_s=0.02))
        assert len(list(source)) == 130
    (recorded,) = source.recordings
    assert recorded.files == tuple(
        tmp_path / f"a{'' if number == 1 else f'-{number}'}.mcap" for number in range(1, 131)
    )
