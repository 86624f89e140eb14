import importlib.util
from pathlib import Path

import numpy as np
import pytest

from nurbseg.drivers.registry import open_source
from nurbseg.drivers.synthetic.source import SyntheticOptions, SyntheticSource

RECORDINGS = Path(__file__).parents[2] / "recordings"
DEMO = RECORDINGS / "demo.mcap"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("make_demo", RECORDINGS / "make_demo.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def assert_alike(recorded, rendered):
    # Another processor may round single values the other way.
    assert (recorded.depth_mm != rendered.depth_mm).mean() < 1e-3
    assert (recorded.labels != rendered.labels).mean() < 1e-3
    # Color went through JPEG.
    assert np.abs(recorded.color.astype(int) - rendered.color).mean() < 3
    assert recorded.timestamp_ns == rendered.timestamp_ns


def test_the_demo_recording_is_what_its_command_makes_today(script):
    with open_source(str(DEMO)) as recording, SyntheticSource(script.DEMO) as source:
        camera, rendered = recording.calibration.depth, source.calibration.depth
        assert recording.calibration.is_registered
        np.testing.assert_allclose(camera.matrix, rendered.matrix)
        assert (camera.width, camera.height) == (rendered.width, rendered.height)
        frames = list(recording)
        assert len(frames) == script.DEMO.frames
        for index in (0, 17, 47):
            source.seek(index)
            assert_alike(frames[index], source.read())


def test_the_demo_recording_is_small_short_and_labelled():
    assert DEMO.stat().st_size < 5e6
    with open_source(str(DEMO)) as recording:
        frames = list(recording)
        assert "12 ball" in recording.metadata["labels"]
    assert 3e9 < frames[-1].timestamp_ns - frames[0].timestamp_ns < 5e9
    assert all(len(np.unique(frame.labels)) == 12 for frame in frames)


def test_the_command_writes_the_recording_to_the_given_path(script, tmp_path, monkeypatch):
    monkeypatch.setattr(script, "DEMO", SyntheticOptions(frames=2, width=80, height=60))
    script.make_demo(tmp_path / "small.mcap", script.DEMO)
    with open_source(str(tmp_path / "small.mcap")) as recording, SyntheticSource(script.DEMO) as source:
        for frame, rendered in zip(recording, source, strict=True):
            assert_alike(frame, rendered)
        assert frame.index == 1
