"""Settings that the chosen method does not read are named in a warning."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from nurbseg.app.batch.batch_command import main as batch_main
from nurbseg.app.settings.app_config import warn_of_unread
from nurbseg.evaluation.eval_command import main as eval_main

Live = Callable[..., subprocess.CompletedProcess[str]]

NO_LEVEL = "level: no effect with stag15, only with the method nurbseg"
NO_SVD = "least_squares: no effect with nurbseg, only with the method stag15"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--method", "stag15", "--level", "surfaces"], NO_LEVEL),
        (["--set", "least_squares=svd"], NO_SVD),
        (["--method", "stag15", "--inverse-depth-noise", "1"], "inverse_depth_noise: no effect with stag15"),
    ],
)
def test_the_live_command_warns(live: Live, words: list[str], said: str) -> None:
    done = live("--replay", "nowhere", "--view", "none", *words)
    assert done.returncode == 2
    assert f"nurbseg-live: warning: {said}" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["--level", "surfaces"],
        ["--method", "stag15", "--set", "least_squares=svd", "--metric", "mae"],
        ["--method", "stag15", "--level", "objects"],
        ["--method", "stag15", "--depth-average", "2", "--inverse-depth-noise", "1"],
    ],
)
def test_settings_that_have_an_effect_are_not_named(live: Live, words: list[str]) -> None:
    done = live("--replay", "nowhere", "--view", "none", *words)
    assert done.returncode == 2
    assert "no effect" not in done.stderr


def test_batches_studies_and_tuning_warn(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    chosen = ["--set", "level=surfaces"]
    assert batch_main(["nowhere", "--export", str(tmp_path), *chosen, "--set", "method=stag15"]) == 1
    assert caplog.messages == [NO_LEVEL]
    assert eval_main(["nowhere", "--methods", "stag15", "--grid", "level=surfaces,objects"]) == 2
    assert eval_main(["nowhere", "--methods", "stag15,nurbseg", *chosen]) == 2
    assert caplog.messages == [NO_LEVEL] * 2
    assert eval_main(["tune", "nowhere", "--method", "stag15", *chosen]) in (1, 2)
    assert caplog.messages == [NO_LEVEL] * 3


def test_the_earlier_method_reads_what_the_paper_s_does(caplog: pytest.LogCaptureFixture) -> None:
    warn_of_unread(["stag15.least_squares", "metric"], ["pz14"])
    assert caplog.messages == []


def test_settings_of_a_file_that_only_live_runs_apply_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[depth]\nrange_max_m = 2.0\n[source]\nspeed = 0.0\nintrinsics = [500, 500, 320, 240]\n")
    words = ["nowhere", "--export", str(tmp_path / "out"), "--config", str(file)]
    assert batch_main(words) == 1
    assert caplog.messages == [
        f"{file}: source.intrinsics, depth.range_max_m: only nurbseg-live applies this"
    ]
