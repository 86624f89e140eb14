"""A method of one's own, by the name of its module and function."""

from pathlib import Path

import pytest

from nurbseg.evaluation.eval_command import main

SOURCE = """
import numpy as np

def by_distance(cloud, rng):
    return np.where(cloud.valid, 1 + (cloud.points_m[..., 2] > {limit_m}), 0)

def flat(cloud, rng):
    return np.ones(7)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "own"
    folder.mkdir()
    path = folder / "own_methods.py"
    path.write_text(SOURCE.format(limit_m=1.2))
    monkeypatch.syspath_prepend(str(folder))
    return path


def run(frames: Path, out: Path, function: str) -> int:
    words = ["run", str(frames), "--methods", "", "--method-from", function, "--frames", "2", "--no-report"]
    return main([*words, "--time-frames", "1", "--out", str(out)])


def test_a_function_of_another_module_is_scored_and_timed(frames: Path, tmp_path: Path, module: Path) -> None:
    out = tmp_path / "out"
    assert run(frames, out, "own_methods:by_distance") == 0
    page = (out / "tables.md").read_text()
    # The box is nearer than the limit, and the wall farther.
    row = next(
        line for line in page.splitlines() if line.startswith("| own_methods:by_distance | 1.000 | 1.000")
    )
    assert row.split("|")[-2].strip().isdigit()
    files = {path: path.stat().st_mtime_ns for path in out.glob("labels/*/*.png")}
    assert run(frames, out, "own_methods:by_distance") == 0
    assert files == {path: path.stat().st_mtime_ns for path in out.glob("labels/*/*.png")}
    # Another source is another variant.
    module.write_text(SOURCE.format(limit_m=1.3))
    assert run(frames, out, "own_methods:by_distance") == 0
    assert len([*out.glob("labels/*/*.png")]) == 2 * len(files)


@pytest.mark.parametrize(
    ("function", "text"),
    [
        ("no_such_module:f", "--method-from no_such_module: there is no such module; install it, or name"),
        ("no.such:f", "--method-from no.such: there is no such module"),
        ("own_methods:nothing", "own_methods has no such function"),
        ("own_methods", "expected MODULE:FUNCTION"),
        ("own_methods:flat", "own_methods:flat: expected labels (72, 96) of whole numbers, got (7,) float64"),
    ],
)
def test_what_is_no_method_is_named(
    frames: Path, tmp_path: Path, module: Path, function: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(frames, tmp_path / "out", function) == 2
    assert text in capsys.readouterr().err
