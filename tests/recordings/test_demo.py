from pathlib import Path

import numpy as np
import pytest

import make_demo
from nurbseg.drivers.registry import open_source
from scene.source import SyntheticOptions, SyntheticSource

DEMO = Path(make_demo.__file__).with_name("demo.mcap")


def assert_alike(recorded, rendered):
    # Another processor may round single values the other way.
    assert (recorded.depth_mm != rendered.depth_mm).mean() < 1e-3
    assert (recorded.labels != rendered.labels).mean() < 1e-3
    # Color went through JPEG.
    assert np.abs(recorded.color.astype(int) - rendered.color).mean() < 3
    assert recorded.timestamp_ns == rendered.timestamp_ns


def test_the_demo_recording_is_what_its_command_makes_today():
    with open_source(str(DEMO)) as recording, SyntheticSource(make_demo.DEMO) as source:
        camera, rendered = recording.calibration.depth, source.calibration.depth
        assert recording.calibration.is_registered
        np.testing.assert_allclose(camera.matrix, rendered.matrix)
        assert (camera.width, camera.height) == (rendered.width, rendered.height)
        frames = list(recording)
        assert len(frames) == make_demo.DEMO.frames
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


@pytest.mark.parametrize("scene", [[], ["--scene", "frames=2&width=80&height=60&seed=3"]])
def test_the_command_writes_the_recording_to_the_given_path(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(make_demo, "DEMO", SyntheticOptions(frames=2, width=80, height=60))
    expected = SyntheticOptions.from_text(scene[1]) if scene else make_demo.DEMO
    path = tmp_path / "small.mcap"
    monkeypatch.setattr("sys.argv", ["make_demo.py", "--out", str(path), *scene])
    make_demo.main()
    with open_source(path) as recording, SyntheticSource(expected) as source:
        for frame, rendered in zip(recording, source, strict=True):
            assert_alike(frame, rendered)
            assert np.array_equal(frame.color, rendered.color) == bool(scene)
