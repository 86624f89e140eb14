"""Benchmarks: what they import and measure, and the comparison of two measurements of speed."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from child_python import run_python

from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import register

pytest.importorskip("skimage")
ALL = Path(__file__).parent.parent / "benchmarks" / "all.py"
DEMO = Path(__file__).parent.parent / "recordings" / "demo.mcap"


@pytest.mark.parametrize(
    ("factor", "code", "said"),
    [
        (1.0, 0, "0 of 2 slower"),
        (1.5, 1, "fit, ms: +50 %; confidence 100%\n1 of 2 slower"),
        (0.5, 0, "0 of 2 slower"),
    ],
)
def test_what_became_slower_is_named_with_its_confidence(
    tmp_path: Path, factor: float, code: int, said: str
) -> None:
    times = 10 + np.random.default_rng(0).normal(0, 0.1, 12)
    for name, factors in (("before", (1.0, 1.0)), ("after", (factor, 1.02))):
        values = {
            name: list(factor * times) for name, factor in zip(("fit, ms", "cut, ms"), factors, strict=True)
        }
        document = {"machine": {"computer": "one"}, "values": values}
        (tmp_path / name).write_text(json.dumps(document))
    done = subprocess.run(
        [sys.executable, ALL, "--compare", "before", "after"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == code, done.stderr
    assert said in done.stdout


def test_few_measurements_that_scatter_are_not_certain(tmp_path: Path) -> None:
    for name, values in (("before", [10.0, 10.0, 20.0]), ("after", [11.0, 10.0, 20.0])):
        (tmp_path / name).write_text(
            json.dumps({"machine": {"computer": name}, "values": {"fit, ms": values}})
        )
    done = subprocess.run(
        [sys.executable, ALL, "--compare", "before", "after"], cwd=tmp_path, capture_output=True, text=True
    )
    assert "two computers: before; after" in done.stdout
    assert "0 of 1 slower" in done.stdout
    assert "fit, ms: +10 %; confidence" in done.stdout
    assert done.returncode == 0


@pytest.mark.parametrize("method", ["nurbseg", "stag15"])
def test_the_time_of_each_stage_is_measured(method: str) -> None:
    done = subprocess.run(
        [
            sys.executable,
            ALL.with_name("segmentation.py"),
            "--frames",
            "1",
            "--repeat",
            "1",
            "--method",
            method,
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    head, row = (line for line in done.stdout.splitlines() if line.startswith(("frame ", "0 ")))
    values = dict(zip(head.replace("every pixel", "every_pixel").split(), row.split(), strict=True))
    stages = [
        "fit",
        *(["split", "borders", "merge"] if method == "nurbseg" else ["cut", "clean-up", "every_pixel"]),
    ]
    assert all(float(values[stage]) > 0 for stage in stages), values
    with open_source(DEMO) as source:
        tree = segment(register(source.read()), SegmentationConfig(method=method))
    assert int(row.split()[-3]) == len(tree.leaves())


def test_benchmarks_find_what_they_import_of_the_project() -> None:
    script = """
import importlib, pathlib, sys
for path in sorted(pathlib.Path().glob("*.py")):
    try:
        importlib.import_module(path.stem)
    except ModuleNotFoundError as error:
        if error.name.partition(".")[0] == "nurbseg":
            raise
        print(error.name)
"""
    missing = run_python(script, cwd=ALL.parent).stdout.split()
    # What only some of them need may not be installed.
    assert set(missing) <= {"cosmic_ray", "sklearn", "skimage"}


def test_a_replay_of_merges_knows_what_was_merged() -> None:
    """Three surfaces: the first two are of one region, the third is another."""
    pytest.importorskip("sklearn")
    script = """
from dataclasses import replace
import numpy as np
from merging import Surfaces, merged, merged_by_truth, rows_of, scores
from nurbseg.segmentation.objects.pair_features import NODE, model_of
from nurbseg.segmentation.objects.border_statistics import SAMPLES, BorderStatistics
from nurbseg.segmentation.objects.merge import Measured
from nurbseg.segmentation.objects.pair_features import NAMES, Scene
pairs, samples = [[1, 2], [1, 3], [2, 3]], [100.0, 5.0, 7.0]
borders = BorderStatistics(np.array(pairs), np.random.default_rng(0).uniform(0, 1, (3, 19)))
borders.sums[:, SAMPLES] = samples
surfaces = np.random.default_rng(1).uniform(1, 2, (4, 19))
surfaces[:, 0] = 0, 10, 20, 40
scene = Scene((0.8, 0.8, 0.0, 0.0), 1.0, 2.0, 2e-3, (0.0, 0.0, -1.0), -1.0)
common = np.array([[0, 0, 0], [0, 10, 0], [0, 20, 0], [0, 0, 40]])
frame = Surfaces(0, Measured(borders, surfaces, scene, np.zeros((3, 10))), common)
features, same, weight = rows_of(frame, None, np.random.default_rng(0))
print(same.astype(int).tolist(), np.round(weight**2).astype(int).tolist())
print(np.round(np.exp(features[:, NAMES.index("length")])).astype(int).tolist())
fourfold = rows_of(replace(frame, weight=4.0), None, np.random.default_rng(0))[2]
print(np.round(fourfold / weight, 6).tolist())
print(scores(frame, merged_by_truth(frame))[1], round(scores(frame, np.arange(4))[1], 4))
for odds in (1.0, -1.0):
    print(*(each.tolist() for each in merged(frame, model_of(np.array([(0, 0, -1, -1, odds)], dtype=NODE)))))
"""
    lines = run_python(script, cwd=ALL.parent).stdout.splitlines()
    same, length, fourfold, covering, all_merged, none = lines
    # Three pairs, of which one is true; then the merged surface and the third.
    assert same == "[1, 0, 0, 0] [10, 10, 20, 30]"
    assert length == "[100, 5, 7, 12]"
    assert fourfold == "[4.0, 4.0, 4.0, 4.0]"
    # Unmerged, the region of 30 pixels is covered by 20, the other wholly.
    assert covering == f"1.0 {(30 * 20 / 30 + 40) / 70:.4f}"
    assert all_merged == "[0, 1, 1, 1] [[1, 2], [1, 3]]"
    assert none == "[0, 1, 2, 3] []"


@pytest.mark.parametrize("family", ["tabletops", "rooms"])
def test_a_simulated_frame_is_the_same_for_its_seed_and_labels_what_has_depth(family: str) -> None:
    pytest.importorskip("pybullet")
    pytest.importorskip("embreex")
    script = """
import sys
import numpy as np
from make import frame
one, again, other = (frame(sys.argv[1], 1, index) for index in (0, 0, 1))
label, deep, same = one["label"], one["depth"] > 0, np.array_equal
print(all(same(one[kind], again[kind]) for kind in one), same(one["depth"], other["depth"]))
print((deep[label > 0]).all(), (label[deep] > 0).mean() > 0.95)
values, pixels = np.unique(label[label > 0], return_counts=True)
print(values[pixels.argmax()] < 10, len(set(values[values > 9] // 10)) >= 3, pixels.min() >= 40)
"""
    lines = run_python(script, family, cwd=ALL.parent / "scenes").stdout.splitlines()
    assert lines[-3:] == ["True False", "True True", "True True True"]


def test_every_file_and_test_of_the_mutation_sample_exists() -> None:
    plan = tomllib.loads(ALL.with_name("mutation.toml").read_text())
    script = """
import sys
import tomllib
from mutation_report import source_of
print(*map(source_of, sys.argv[1:]), sep="\\n")
"""
    files = run_python(script, *plan["tests"], cwd=ALL.parent).stdout.split()
    tests = {test for tests in plan["tests"].values() for test in tests if test.startswith("tests/")}
    root = ALL.parent.parent
    assert [name for name in {*files, *tests} if not (root / name).exists()] == []


def test_each_package_has_a_mutation_score_of_its_own() -> None:
    script = """
from types import SimpleNamespace
from mutation_report import Mutant, Outcome, report
place = SimpleNamespace(definition_name="f")
def outcomes(module, states):
    return [Outcome(Mutant(module, place, "a", "b"), state, kind) for state, kind in states]
died, lives, same = ("killed", ""), ("survived", ""), ("survived", "equivalent")
print(report([*outcomes("cut/ncut", [died, died, same]),
              *outcomes("library/boxes/boxes", [died, lives, died, lives]),
              *outcomes("library/objects", [("timeout", "")])],
             ["cut/ncut", "library/boxes/boxes", "library/objects"], [], 60.0))
"""
    rows = {}
    for line in run_python(
        script, cwd=ALL.parents[1], environment={"PYTHONPATH": str(ALL.parent)}
    ).stdout.splitlines():
        name, *cells = [word.strip() for word in line.strip("|").split("|")]
        rows[name] = cells
    # Files, share of the lines, then: changes, noticed, by a time limit, equivalent, survivors, score.
    assert rows["`segmentation`"][2:] == ["3", "2", "0", "1", "0", "100 %"]
    assert rows["`drivers`"][2:] == ["0", "0", "0", "0", "0", ""]
    assert rows["`library`"][0] == "2"
    assert rows["`library`"][2:] == ["5", "3", "1", "0", "2", "60 %"]
    assert rows["`library/boxes/boxes.py`"] == ["4", "2", "0", "0", "2", "50 %"]
    assert rows["**all**"] == ["8", "5", "1", "1", "2", "71 %"]
    lines = {
        name: sum(len(path.read_bytes().splitlines()) for path in (ALL.parents[1] / "library").glob(name))
        for name in ("**/*.py", "boxes/boxes.py", "objects.py")
    }
    percent = 100 * (lines["boxes/boxes.py"] + lines["objects.py"]) / lines["**/*.py"]
    assert rows["`library`"][1] == f"{percent:.0f} %"


def test_frames_of_one_smooth_surface_depend_on_their_index_alone_and_are_half_full() -> None:
    script = """
import numpy as np
from smooth import smooth_surfaces
frames = list(smooth_surfaces(12))
again = next(smooth_surfaces(1))
print(all(np.array_equal(getattr(frames[0], name), getattr(again, name)) for name in ("depth_mm", "labels")))
print(all((frame.depth_mm > 0).mean() >= 0.5 for frame in frames))
print(all(np.array_equal(frame.labels, 10 * (frame.depth_mm > 0)) for frame in frames))
"""
    assert run_python(script, cwd=ALL.parent).stdout.split() == ["True"] * 3
