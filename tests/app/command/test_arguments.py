import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest

from nurbseg.app.batch.batch_command import main as batch_main
from nurbseg.app.command.arguments import parse_arguments
from nurbseg.app.devices.devices_command import main as devices_main
from nurbseg.app.recording.record_command import main as record_main
from nurbseg.app.settings.app_config import WITHOUT_FLAG, AppConfig, flags
from nurbseg.common.settings import setting_paths
from nurbseg.evaluation.eval_command import main as eval_main
from nurbseg.segmentation.config import Level, Method, Metric


def refusal(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as caught:
        parse_arguments(words)
    assert caught.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_without_arguments_the_defaults_hold() -> None:
    arguments = parse_arguments([])
    assert arguments.config == AppConfig()
    assert not arguments.print_config


def test_every_setting_is_in_the_help_with_unit_and_default(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse_arguments(["--help-all"])
    assert caught.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for _, field in setting_paths(AppConfig):
        # Of the others, --print-config says what these say of themselves.
        assert flags(field)[0] in text or field.name in WITHOUT_FLAG
    assert "exposure of the color camera, in its own units [at least 0]" in text
    assert "minimum segment size, in pixels of a 640x480 image [px, at least 1] (default: 120)" in text
    assert "130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP" in text


def test_the_short_help_fits_a_screen_and_names_flags_and_values_that_there_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    texts = []
    for flag in ("--help", "-h", "--help-all"):
        with pytest.raises(SystemExit) as caught:
            parse_arguments([flag])
        assert caught.value.code == 0
        texts.append(capsys.readouterr().out)
    short, again, everything = texts
    assert short == again
    assert 24 <= len(short.splitlines()) <= 40
    assert max(map(len, short.splitlines())) <= 80
    named = set(re.findall(r"--[a-z-]+", short))
    assert len(named) > 20
    assert named <= set(re.findall(r"--[a-z-]+", everything))
    for words in ("--metric", get_args(Metric)), ("--method", get_args(Method)), ("--level", get_args(Level)):
        (line,) = (line for line in short.splitlines() if line.strip().startswith(words[0]))
        assert set(words[1]) <= set(re.findall(r"[a-z0-9]+", line.partition("NAME")[2]))


def test_no_two_settings_share_a_flag() -> None:
    names = Counter(name for _, field in setting_paths(AppConfig) for name in flags(field))
    assert [name for name, uses in names.items() if uses > 1] == []


def test_flags_are_called_as_the_fields_and_as_in_the_literature() -> None:
    words = ["--ratio-max", "0.9", "--lambda", "2", "--metric", "VMXC", "--segment-pixels-min", "500"]
    settings = parse_arguments(words).config.segmentation
    assert (settings.ratio_max, settings.geometry_weight) == (0.9, 2.0)
    assert (settings.metric, settings.stag15.segment_pixels_min) == ("vmxc", 500)
    assert parse_arguments(["--threshold", "0.8"]).config.segmentation.ratio_max == 0.8
    assert parse_arguments(["--geometry-weight", "3"]).config.segmentation.geometry_weight == 3.0


def test_flags_override_the_file_and_the_file_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text("[segmentation]\nratio_max = 0.9\nseed = 4\n[source]\nloop = true\n")
    config = parse_arguments(["--config", str(path), "--seed", "7", "--no-loop"]).config
    assert (config.segmentation.ratio_max, config.segmentation.seed) == (0.9, 7)
    assert not config.source.loop


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--replay", "b"], ("replay",)),
        (["--device", "xtion"], ("device",)),
        (["--color", "*.jpg", "--depth", "*.png"], ("color_images",)),
        ([], ("replay",)),
    ],
)
def test_a_source_on_the_command_line_takes_the_place_of_the_files(
    words: list[str], named: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "run.toml"
    path.write_text("[source]\nreplay = 'a'\n")
    assert parse_arguments(["--config", str(path), *words]).config.source.named == named


def test_a_pattern_that_the_shell_expanded_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [str(tmp_path / f"{number}.png") for number in range(3)]
    for name in names:
        Path(name).touch()
    with pytest.raises(SystemExit):
        parse_arguments(["--color", *names, "--depth", "x"])
    assert "put patterns in quotes" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["run.mcap", "--speed", "0"], ["--speed", "0", "--", "run.mcap"]])
def test_a_path_is_replayed(words: list[str]) -> None:
    source = parse_arguments(words).config.source
    assert (source.replay, source.speed) == ("run.mcap", 0.0)
    assert parse_arguments(["--", "-run"]).config.source.replay == "-run"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ["--ratio-max", "-1"],
            "argument --ratio-max/--threshold: expected a finite number, more than 0, got -1",
        ),
        (["--seed", "1.5"], "argument --seed: expected a whole number, at least 0, got 1.5"),
        (["--speed", "nan"], "argument --speed: expected a finite number, at least 0, got nan"),
        (["--speed", "-1"], "argument --speed: expected a finite number, at least 0, got -1"),
        (["--duration", "0"], "argument --duration: expected a finite number, more than 0, got 0"),
        (["--frames", "0"], "argument --frames: expected a whole number, at least 1, got 0"),
        # A window of so many pixels would be summed without end, and such noise cannot be squared.
        (
            ["--set", "normal_window_px=10000000000"],
            "normal_window_px: expected a whole number, at least 3, at most 640",
        ),
        (["--set", "bind=::1"], "bind: expected one of view.bind, publish.bind"),
        (["--set", "points-max=x"], "points_max: expected a whole number"),
        (["--set", "pionts_max=3"], "no such setting (did you mean view.points_max?)"),
        (["--set", "samples"], "samples: expected NAME=VALUE"),
        (["--set", "samples=x"], "samples: expected a whole number, at least 2, at most 2000, got 'x'"),
        (
            ["--inverse-depth-noise", "1e308"],
            "argument --inverse-depth-noise: expected a finite number, more than 0, at most 1",
        ),
        (["--intrinsics", "1,2,3"], "--intrinsics: expected 4 numbers, separated by commas, got [1, 2, 3]"),
        (["--intrinsics=-1,2,3,4"], "argument --intrinsics: expected focal lengths"),
        (["--metric", "foo"], "argument --metric: expected one of mse, mae, "),
        (["--metric", "msee"], "nlc, got 'msee' (did you mean mse?)\n"),
        (["--replay", "a", "--device", "any"], "not allowed with argument --replay"),
        (["--export-surfaces"], "--export-surfaces: expected a folder too"),
        (["--temporel", "on"], "unrecognized arguments: --temporel; --temporel is near --temporal"),
        (["--replay", "-a.mcap"], "expected one argument; a name that begins with '-' is given as ./-NAME"),
        (["--exports=out"], "--exports=out is near --export"),
        (["--treshold", "1"], "--treshold is near --threshold\n"),
        (["--replay", ""], "argument --replay: expected a value, got ''"),
        (["--export", ""], "argument --export: expected a value, got ''"),
        (["--replay", "a", "--fames", "30"], "error: unrecognized arguments: --fames; --fames is near"),
        (["--replay", "a", "b"], "argument PATH: not allowed with argument --replay; one recording is"),
        (["/", "/usr"], "unrecognized arguments: /usr; one recording is replayed; put patterns in quotes"),
        (["a", "--device", "xtion"], "argument --device: not allowed with argument PATH"),
        (["a", "--replay", "b"], "argument --replay: not allowed with argument PATH"),
        (["--color", "*.jpg"], "argument --depth: expected a pattern; color and depth"),
        (["--color", "*.jpg", "--depth", "*.png", "--replay", "x"], "not allowed with argument"),
        (["--export-mesh", "glb"], "--export-mesh: expected a folder too"),
        (["--export-cloud", "xyz", "--export", "out"], "argument --export-cloud: expected one of "),
        (["--config", "no-such.toml"], "no-such.toml: cannot be read"),
        (["--ratio", "1"], "unrecognized arguments: --ratio"),
        (["--quiet", "--verbose"], "not allowed with argument"),
    ],
)
def test_wrong_arguments_are_refused_with_their_names(
    words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert complaint in refusal(words, capsys) + "\n"


@pytest.mark.parametrize(("words", "verbosity"), [([], 0), (["--quiet"], -1), (["--verbose"], 1)])
def test_loudness(words: list[str], verbosity: int) -> None:
    assert parse_arguments(words).verbosity == verbosity


@pytest.mark.parametrize(
    ("name", "main"),
    [
        ("batch", batch_main),
        ("devices", devices_main),
        ("eval", eval_main),
        ("live", parse_arguments),
        ("record", record_main),
    ],
)
def test_every_command_prints_the_version(
    name: str,
    main: Callable[[list[str]], object],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("importlib.metadata.version", {"nurbseg": "1.2.3"}.__getitem__)
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert not ended.value.code
    assert capsys.readouterr().out == f"nurbseg-{name} 1.2.3\n"
