"""Warnings begin with the command's name as errors do, and each is there once, whoever reads."""

import subprocess
import sys
from pathlib import Path

import pytest
from recorded_scene import scenes, write_tum


def run(module: str, *words: str, cwd: Path) -> list[str]:
    """Run a command, and return the lines of its standard error."""
    program = f"import sys; from nurbseg.{module} import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-P", "-c", program, *words],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done.stderr.splitlines()


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("app.batch.batch_command", ["tum", "--export", "out", "--workers", "2"]),
        ("app.batch.batch_command", ["tum", "--export", "out", "--workers", "1"]),
        ("evaluation.eval_command", ["noise", "tum"]),
    ],
)
def test_a_warning_begins_with_the_command_and_is_there_once(
    tmp_path: Path, module: str, words: list[str]
) -> None:
    write_tum(tmp_path / "tum", scenes(2))
    with (tmp_path / "tum" / "depth.txt").open("a") as file:
        file.write("no stamp\n")
    lines = run(module, *words, cwd=tmp_path)
    name = {"app.batch.batch_command": "nurbseg-batch", "evaluation.eval_command": "nurbseg-eval"}[module]
    told = [line for line in lines if "lines are skipped" in line]
    assert len(told) == 1, lines
    assert told[0].startswith(f"{name}: warning: tum/depth.txt: line ")
    assert all(line.startswith(f"{name}: ") for line in lines), lines


def test_a_recording_that_is_cut_off_is_told_in_the_same_way(tmp_path: Path) -> None:
    demo = Path(__file__).parents[2] / "recordings" / "demo.mcap"
    (tmp_path / "a.mcap").write_bytes(demo.read_bytes()[:400_000])
    lines = run("app.recording.record_command", "repair", "a.mcap", cwd=tmp_path)
    assert all(line.startswith("nurbseg-record: warning: a.mcap: ") for line in lines), lines
    assert "is cut off" in lines[0]
