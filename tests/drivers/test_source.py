"""What a source is by itself."""

import pytest
from scripted_source import ScriptedSource, small_frame

from nurbseg.drivers import DeviceLostError, FrameFormatError, FrameTimeoutError, RGBDFrame


def test_a_loop_over_a_source_passes_over_damaged_frames_and_names_the_first(caplog) -> None:
    bad = [FrameFormatError(f"bad {n}") for n in range(30)]
    with ScriptedSource([small_frame(0), *bad, small_frame(31)]) as source:
        assert [frame.index for frame in source] == [0, 31]
        assert source.metadata["damaged"] == "30"
    assert len(caplog.messages) == 20
    assert caplog.messages[0] == "skipped a damaged frame: bad 0"
    assert caplog.messages[-1].endswith("bad 19; further ones are only counted")
    lost = ScriptedSource([small_frame(0), DeviceLostError("gone")])
    with lost as source, pytest.raises(DeviceLostError, match="gone"):
        list(source)


def test_a_loop_over_a_camera_waits_as_long_as_the_camera_may_be_silent() -> None:
    waits: list[float] = []

    class Camera(ScriptedSource):
        def _read(self, timeout_s: float) -> RGBDFrame:
            waits.append(timeout_s)
            return super()._read(timeout_s)

    script = [small_frame(0), FrameTimeoutError("silent"), small_frame(2), small_frame(3)]
    with Camera(script, live=True) as source:
        with pytest.raises(FrameTimeoutError, match="silent"):
            list(source)
        source.silence_s = 3.5
        assert next(iter(source)).index == 2
        source.read(0.25)
    assert waits == [10.0, 10.0, 3.5, 0.25]


def test_skipping_by_reading_counts_damaged_frames_and_passes_other_errors_on() -> None:
    script = [small_frame(0), FrameFormatError("bad"), small_frame(2), FrameTimeoutError("late")]
    with ScriptedSource(script) as source:
        assert source.skip(2) == 2
        assert source.read().index == 2
        with pytest.raises(FrameTimeoutError):
            source.skip(1)
