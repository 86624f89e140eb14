"""The search for settings."""

from functools import lru_cache
from pathlib import Path

import pytest

from nurbseg.app.command.config_file import read_config
from nurbseg.evaluation import tuning
from nurbseg.evaluation.eval_command import main
from nurbseg.evaluation.study import Study
from nurbseg.segmentation.config import SegmentationConfig


def test_tuning_writes_settings_that_the_live_command_reads(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tuned.toml"
    words = ["tune", str(frames), "--budget", "4", "--out", str(out), "--set", "samples=40"]
    assert main(words) == 0
    assert read_config(out).segmentation.samples == 40
    assert "95 % interval" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("method", "smallest"), [("stag15", "segment_pixels_min"), ("nurbseg", "piece_pixels_min")]
)
def test_the_search_is_over_settings_that_the_method_uses(
    frames: Path, tmp_path: Path, method: str, smallest: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["tune", str(frames), "--budget", "2", "--frames", "2", "--method", method]
    assert main([*words, "--out", str(tmp_path / "tuned.toml")]) == 0
    searched = [line.partition(" = ")[0] for line in capsys.readouterr().out.splitlines() if " = " in line]
    assert smallest in searched
    assert len(searched) == 6


def test_the_same_seed_finds_the_same_settings(frames: Path, tmp_path: Path) -> None:
    for name in ("a.toml", "b.toml"):
        words = ["tune", str(frames), "--budget", "3", "--seed", "5", "--frames", "3"]
        assert main([*words, "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "a.toml").read_text() == (tmp_path / "b.toml").read_text()


def test_of_more_frames_than_are_kept_only_the_others_are_read_again(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []

    @lru_cache(maxsize=3)
    def labeled_cloud(ref, **more):
        read.append(ref.index)
        return whole(ref, **more)

    whole = tuning._labeled_cloud.__wrapped__
    monkeypatch.setattr(tuning, "_labeled_cloud", labeled_cloud)
    words = ["tune", str(frames), "--budget", "3", "--jobs", "1", "--out", str(tmp_path / "tuned.toml")]
    assert main(words) == 0
    assert read == [0, 1, 2, 3, 4, 1, 0, 3, 4]


def test_the_initial_settings_are_first_and_scores_in_the_order_of_frames(
    frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables, tried = [], []

    def objective(ref, labeled, config):
        tried.append(config)
        return float(ref.index)

    monkeypatch.setattr(tuning, "_frame_objective", objective)
    monkeypatch.setattr(tuning, "_cross_validated_gain", lambda table, folds, seed: tables.append(table))
    start = SegmentationConfig(
        metric="vgc", ratio_max=0.77, geometry_weight=2.5, splitting_point="zero", seed=3
    )
    tuning.tune(Study((str(frames),), ()), start, budget=3)
    assert tables[0].tolist() == [[0.0, 1.0, 2.0, 3.0, 4.0]] * 3
    assert [config == start for config in tried] == [True] * 5 + [False] * 10


def test_a_damaged_frame_does_not_end_the_search(frames: Path, tmp_path: Path) -> None:
    damaged = frames / "learn2_depth.png"
    damaged.write_bytes(damaged.read_bytes()[:60])
    words = ["tune", str(frames), "--budget", "2", "--out", str(tmp_path / "tuned.toml")]
    assert main(words) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--folds", "1"], "at least 2"),
        (["--budget", "1"], "at least 2"),
        (["--out", "/no/such/folder/t.toml"], "/no/such/folder/t.toml"),
        (["--out", "/proc/t.toml"], "nurbseg-eval: error: --out /proc/t.toml: cannot be written: "),
    ],
)
def test_what_cannot_work_is_said_before_the_search(
    frames: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tune", str(frames), *words]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.out == ""
