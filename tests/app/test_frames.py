import pickle
from collections.abc import Iterator

import pytest
from rendered import rendered

from nurbseg.app import frames
from nurbseg.app.frames import Reader, survey
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source

OPTIONS = SourceOptions()


def scene(seed: int) -> str:
    return rendered(f"width=64&height=48&frames=12&seed={seed}")


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was opened so far."""
    found: list[str] = []

    def opens(uri: str, options: SourceOptions) -> object:
        found.append(uri)
        return open_source(uri, options)

    monkeypatch.setattr(frames, "open_source", opens)
    return found


@pytest.fixture
def reader() -> Iterator[Reader]:
    made = Reader()
    yield made
    made.close()


def test_places_are_those_of_all_frames_or_some() -> None:
    assert survey(scene(0), OPTIONS)[0] == range(12)
    assert survey(scene(0), OPTIONS, 3, 5)[0] == range(3, 8)
    assert survey(scene(0), OPTIONS, 10, 5)[0] == range(10, 12)


def test_the_survey_gives_the_cameras_of_the_recording() -> None:
    with open_source(scene(0), OPTIONS) as source:
        assert survey(scene(0), OPTIONS)[1].depth.fx == source.read().calibration.depth.fx


def test_frames_at_later_places_are_read_without_opening_again(reader: Reader, opened: list[str]) -> None:
    uri = scene(0)
    for run in (range(2), range(4, 7), range(9, 12)):
        # Each task of another process brings a copy.
        options = pickle.loads(pickle.dumps(SourceOptions(intrinsics=(60.0, 60.0, 32.0, 24.0))))
        assert [frame.index for frame in reader.read(uri, options, run)] == list(run)
    assert opened == [uri]


def test_earlier_positions_and_other_recordings_are_reopened(reader: Reader, opened: list[str]) -> None:
    first, second = scene(0), scene(1)
    for uri, run in ((first, range(5, 8)), (first, range(2, 3)), (second, range(4, 5)), (first, range(1))):
        assert [frame.index for frame in reader.read(uri, OPTIONS, run)] == list(run)
    assert opened == [first, first, second, first]


def test_options_are_those_of_the_read(reader: Reader, opened: list[str]) -> None:
    uri = scene(0)
    list(reader.read(uri, OPTIONS, range(1)))
    list(reader.read(uri, SourceOptions(depth_scale=1000.0), range(1, 2)))
    assert opened == [uri, uri]


def test_reading_ends_with_the_recording(reader: Reader) -> None:
    assert [frame.index for frame in reader.read(scene(0), OPTIONS, range(10, 20))] == [10, 11]
