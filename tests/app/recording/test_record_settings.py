"""Settings of the recording that is made during a run."""

import pytest

from nurbseg.app.command.arguments import parse_arguments
from nurbseg.app.settings.output_config import RecordConfig


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"file": "run.avi"}, r"expected a name that ends in \.mcap, got 'run\.avi'$"),
        (
            {"file": "x.ONI"},
            r"ends in \.mcap, got 'x\.ONI' \(\.oni recordings are replayed, but no",
        ),
        ({"only": True}, "expected a file"),
        ({"file": "x.mcap", "delay_s": -1.0}, r"delay_s: expected .*at least 0, got"),
        ({"split_s": 60.0}, "expected a file"),
        ({"file": "x.mcap", "color": "gif"}, "color: expected one of"),
    ],
)
def test_wrong_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        RecordConfig(**settings)


@pytest.mark.parametrize("words", [["--export", "out"], ["--save", "out.rrd"]])
def test_recording_only_and_results_exclude_each_other(words, capsys):
    with pytest.raises(SystemExit) as ended:
        parse_arguments(["--record", "x.mcap", "--record-only", *words])
    assert ended.value.code == 2
    assert "nothing is segmented" in capsys.readouterr().err


def test_the_flags_of_a_recording_are_a_section_of_the_configuration():
    words = [
        "--record",
        "x.mcap",
        "--record-delay",
        "2.5",
        "--record-color",
        "png",
        "--set",
        "space_min_mb=50",
    ]
    config = parse_arguments(words).config.record
    assert config == RecordConfig(file="x.mcap", delay_s=2.5, color="png", space_min_mb=50)
