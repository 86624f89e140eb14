"""Running a study: the same table whoever computes it, however often it is cut short."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from hostile_files import black_png
from rendered import rendered

from nurbseg.drivers.mcap.reader import RecordingReader
from nurbseg.evaluation.eval_command import main
from nurbseg.evaluation.methods.methods import labels_on_disk
from nurbseg.evaluation.results import StudyStore
from nurbseg.evaluation.scoring.frame import FrameScores
from nurbseg.evaluation.scoring.objects import ObjectScores
from nurbseg.evaluation.study import category_of

METHODS = "stag15,pz14,fh04,kmeans"


@pytest.fixture(scope="module")
def study(lasting_frames: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """Frames, the folder of their whole study by this process alone, and its tables."""
    folder = tmp_path_factory.mktemp("study") / "whole"
    return lasting_frames, folder, evaluate(lasting_frames, folder)


def evaluate(frames: Path, out: Path, *more: str) -> str:
    words = ["run", str(frames), "--methods", METHODS, "--metrics", "mse,nlc", "--thresholds", "1,0.9"]
    assert main([*words, "--out", str(out), "--time-frames", "0", "--no-report", *more]) == 0
    return (out / "tables.md").read_text()


def score(frames: Path, out: Path, *more: str) -> int:
    """Score one fast method, without a report; return the exit code."""
    words = ["run", str(frames), "--methods", "fh04", "--no-report", "--time-frames", "0"]
    return main([*words, "--out", str(out), *more])


def test_a_killed_run_continues_where_it_was_and_gives_the_same_tables(
    study: tuple[Path, Path, str], tmp_path: Path
) -> None:
    frames, _, whole = study
    out = tmp_path / "killed"
    # In this process's way, which leaves the kernel of matrix products as it is.
    program = "import sys; from nurbseg.evaluation.eval_command import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "run", str(frames), "--methods", METHODS]
    command += ["--metrics", "mse,nlc", "--thresholds", "1,0.9", "--out", str(out), "--no-report"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    limit = time.monotonic() + 60
    while len(list(out.glob("frames/*.json"))) < 2 and process.poll() is None:
        assert time.monotonic() < limit, "no frame was finished in a minute"
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(10)
    finished = {path.name: path.stat().st_mtime_ns for path in out.glob("frames/*.json")}
    assert finished
    assert evaluate(frames, out) == whole
    kept = {path.name: path.stat().st_mtime_ns for path in out.glob("frames/*.json")}
    assert kept.items() >= finished.items(), "finished frames were done again"
    assert len(kept) == 5


def test_the_table_does_not_depend_on_the_number_of_workers(
    study: tuple[Path, Path, str], tmp_path: Path
) -> None:
    frames, _, tables = study
    assert evaluate(frames, tmp_path / "two", "--jobs", "2") == tables


@pytest.mark.filterwarnings("default")
def test_a_dask_cluster_of_two_workers_gives_the_same_table(
    study: tuple[Path, Path, str], tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    frames, _, alone = study
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        shared = evaluate(frames, tmp_path / "shared", "--scheduler", cluster.scheduler_address)
    assert shared == alone


@pytest.mark.parametrize(
    ("installed", "text"),
    [
        (True, "no Dask scheduler answers"),
        (False, "distributed is not installed; evaluation needs the extra 'eval'"),
    ],
)
def test_a_scheduler_that_cannot_be_used_is_a_usage_error(
    frames: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    installed: bool,
    text: str,
) -> None:
    monkeypatch.setattr("nurbseg.app.workers._SCHEDULER_TIMEOUT_S", 0.2)
    if not installed:
        monkeypatch.setitem(sys.modules, "distributed", None)
    assert score(frames, tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9") == 2
    assert text in capsys.readouterr().err


def test_a_second_run_with_more_settings_does_only_the_new_ones(
    study: tuple[Path, Path, str], tmp_path: Path
) -> None:
    frames, whole, _ = study
    out = Path(shutil.copytree(whole, tmp_path / "out"))
    labels = {path: path.stat().st_mtime_ns for path in out.glob("labels/*/*.png")}
    evaluate(frames, out, "--grid", "lambda=1,2")
    assert all(path.stat().st_mtime_ns == moment for path, moment in labels.items())
    assert len(list(out.glob("labels/*/*.png"))) > len(labels)


def test_fewer_frames_of_a_finished_study_are_a_table_of_these(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert score(frames, out) == 0
    assert len((out / "results.csv").read_text().splitlines()) == 6
    assert score(frames, out, "--frames", "2") == 0
    assert len((out / "results.csv").read_text().splitlines()) == 3


def test_a_damaged_frame_is_skipped_with_its_name_and_not_timed(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = frames / "learn0_depth.png"
    damaged.write_bytes(damaged.read_bytes()[:60])
    out = tmp_path / "out"
    words = ["run", str(frames), "--methods", "fh04", "--time-frames", "1", "--out", str(out)]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "learn0_depth.png" in printed.err
    rows = (out / "results.csv").read_text().splitlines()
    named = [row.partition(",")[0].strip('"') for row in rows]
    assert named == ["frame", *(f"learn{n}" for n in range(1, 5))]
    html = (out / "report.html").read_text()
    assert "4 frames, 1 variants, 1 frames skipped" in html
    assert re.search("<li>00-000000: .*learn0_depth.png", html)
    kept = (out / "frames" / "00-000000.json").stat().st_mtime_ns
    assert main(words) == 0
    assert (out / "frames" / "00-000000.json").stat().st_mtime_ns == kept


def test_frames_of_the_object_segmentation_database_have_its_categories() -> None:
    # The last of each, and those after them.
    categories = {"learn16": "boxes", "learn24": "stacked boxes", "learn32": "occluded objects"}
    categories |= {"test15": "boxes", "test42": "cylindric objects", "test54": "mixed objects"}
    categories |= {"test65": "complex scene", "learn17": "stacked boxes", "learn45": "frames"}
    categories |= {"test16": "stacked boxes", "test55": "complex scene"}
    assert {name: category_of(name, "osd/frames") for name in categories} == categories


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "no ground truth\n"),
        (black_png(8, 8), "no ground truth that can be used: {}: expected the depth"),
    ],
)
def test_a_frame_without_ground_truth_that_can_be_used_is_skipped_and_named(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None, why: str
) -> None:
    file = frames / "learn1_label.png"
    file.unlink() if content is None else file.write_bytes(content)
    assert score(frames, tmp_path / "out") == 0
    assert len((tmp_path / "out/results.csv").read_text().splitlines()) == 5
    assert f"skipped 00-000001: {why.format(file)}" in capsys.readouterr().err


@pytest.mark.filterwarnings("default")
def test_a_scheduler_without_workers_is_a_usage_error(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("nurbseg.app.workers._WORKER_TIMEOUT_S", 0.2)
    with distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=None) as cluster:
        assert score(frames, tmp_path / "out", "--scheduler", cluster.scheduler_address) == 2
    assert "it has no worker" in capsys.readouterr().err


def test_the_noise_of_planes_is_measured_past_damaged_frames(
    frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = frames / "learn1_depth.png"
    damaged.write_bytes(damaged.read_bytes()[:60])
    assert main(["noise", str(frames)]) == 0
    printed = capsys.readouterr()
    assert "learn1_depth.png" in printed.err
    assert "in 4 of 5 frames" in printed.out


def test_another_study_s_folder_is_refused(frames: Path, tmp_path: Path) -> None:
    StudyStore(tmp_path / "out", {"sources": ["elsewhere"], "seed": 0})
    with pytest.raises(
        ValueError, match=r"study\.json: contains another study: sources is .* there and .* now"
    ):
        StudyStore(tmp_path / "out", {"sources": [str(frames)], "seed": 0})


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"index": None}, "index: expected a whole number, got None"),
        ({"uri": 3}, "uri: expected a text, got 3"),
        ({"name": []}, r"name: expected a text, got \[\]"),
        ({"category": {}}, r"category: expected a text, got \{\}"),
        ({"computer": ["fast"]}, r"computer: expected a text, got \['fast'\]"),
        ({"results": []}, r"results: expected an object, got \[\]"),
        ({"results": {"a": 1}}, r"results\.a: expected an object, got 1"),
        ({"results": {"a": {}}}, r"results\.a\.ri: expected a number, got 'nothing'"),
        ({"gtrc": None}, r"results\.a\.gtrc: expected a number, got None"),
        (
            {"results": {"a": {"ri": 1, "gtrc": 1, "voi": 1, "obj": 1}}},
            r"results\.a\.segments: .* got 'nothing'",
        ),
        ({"precision": "high"}, r"results\.a\.precision: expected a number or null, got 'high'"),
    ],
)
def test_a_damaged_field_of_a_stored_frame_is_named_with_what_to_do(
    tmp_path: Path, change: dict[str, object], text: str
) -> None:
    store = StudyStore(tmp_path, {})
    scores = dict.fromkeys((*FrameScores._fields, *ObjectScores._fields))
    scores |= {"ri": 1, "gtrc": 0.5, "voi": 0.0}
    frame = {"uri": "a.mcap", "index": 0, "name": "0", "category": "a"}
    frame |= {"truth": "labels", "results": {"a": scores}}
    store.keep("00-000000", frame, {})
    assert store.frame("00-000000") == {**frame, "key": "00-000000"}
    (scores if change.keys() & scores.keys() else frame).update(change)
    store.keep("00-000000", frame, {})
    pattern = rf"frames/00-000000\.json: {text}; remove it to process its frame again"
    with pytest.raises(ValueError, match=pattern):
        store.frame("00-000000")
    assert store.frame("00-000001") == {}


def test_label_images_of_another_program_are_scored(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    for path in frames.glob("*_label.png"):
        truth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(folder / path.name.replace("_label", "_labels")), truth.astype(np.uint16))
    assert score(frames, tmp_path / "out", "--labels", str(folder)) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("labels:"))
    assert row.split()[1] == "1.000"


def test_a_camera_is_no_data_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RecordingReader, "live", True)
    assert score(Path(rendered("width=64&height=48&frames=2")), tmp_path / "out") == 2
    assert "record it first" in capsys.readouterr().err


def encoded(extension: str, image: np.ndarray) -> bytes:
    return cv2.imencode(extension, image)[1].tobytes()


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (black_png(60_000, 50_000), "000003.png: .*expected 16777216 pixels at most"),
        (
            encoded(".tiff", np.ones((3, 4), np.float32)),
            r"000003.png: expected labels \(3, 4\) of whole numbers",
        ),
        (encoded(".png", np.ones((6, 8), np.uint8)), r"000003.png: .* whole numbers, got \(6, 8\) uint8"),
        (b"GIF89a", "000003.png: not an image that can be decoded"),
        ("a pipe", "000003.png: .*not a regular file"),
        (None, r": no labels of frame learn3; expected learn3_labels\.png"),
    ],
)
def test_a_label_image_that_cannot_be_used_is_named(
    tmp_path: Path, content: bytes | str | None, text: str
) -> None:
    if isinstance(content, bytes):
        (tmp_path / "000003.png").write_bytes(content)
    elif content:
        os.mkfifo(tmp_path / "000003.png")
    with pytest.raises(ValueError, match=f"^{tmp_path}(/|(?=:)){text}"):
        labels_on_disk(tmp_path, "learn3", 3, (3, 4))


def test_label_images_of_too_many_labels_are_named(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = tmp_path / "labels"
    labels.mkdir()
    path = sorted(frames.glob("*_label.png"))[0]
    shape = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape
    many = (1 + np.arange(shape[0] * shape[1]) % 60_000).astype(np.uint16).reshape(shape)
    cv2.imwrite(str(path), many)
    cv2.imwrite(str(labels / path.name), many)
    words = ["--frames", "1", "--methods", "", "--labels", str(labels)]
    assert score(frames, tmp_path / "out", *words) == 2
    assert re.search(r"frame .*: labels:.*: \d+ segments and \d+ regions are too", capsys.readouterr().err)


def test_a_start_behind_the_last_frame_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [rendered("width=64&height=48&frames=2"), "--start", "2"]
    for command in (["run", "--out", str(tmp_path / "out")], ["noise"]):
        assert main([*command, *words]) == 2
        assert "frames2.mcap: no frames after --start 2" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["run", "--methods", "fh04"], ["tune", "--budget", "2"]])
@pytest.mark.parametrize(("content", "why"), [(None, ""), (b"no image", r" \(.*/frames/.*_label\.png: .*\)")])
def test_frames_without_ground_truth_that_can_be_used_are_no_data_set(
    frames: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    content: bytes | None,
    why: str,
) -> None:
    for path in frames.glob("*_label.png"):
        path.unlink() if content is None else path.write_bytes(content)
    assert main([*words, str(frames), "--out", str(tmp_path / "out")]) == 2
    none = rf"error: .*(no frame has|at least 2 frames with) ground truth{why}(; see .*)?$"
    assert re.search(none, capsys.readouterr().err, re.MULTILINE)


@pytest.mark.parametrize(
    "words",
    [
        ["--methods", "magic"],
        ["--metrics", "mses"],
        ["--metrics", "mses", "--methods", "fh04"],
        ["--thresholds", "one"],
        ["--grid", "lambda"],
        ["--labels", "/no/such/folder"],
        ["--intrinsics", "1,2,3"],
        ["--frames", "0"],
        ["--set", "samples=1"],
    ],
)
def test_wrong_arguments_end_with_2_and_name_themselves(
    frames: Path, tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(frames), "--out", str(tmp_path / "out"), *words]) == 2
    assert capsys.readouterr().err.startswith("nurbseg-eval: error: ")


def test_nothing_is_written_before_data_and_options_are_checked(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in frames.glob("*.png"):
        (bare / path.name).write_bytes(path.read_bytes())
    words = ["run", str(bare), "--methods", "fh04", "--time-frames", "0", "--no-report", "--out"]
    out = tmp_path / "out"
    assert main([*words, str(out)]) == 2
    assert "--intrinsics" in capsys.readouterr().err
    assert not out.exists()
    assert main([*words, str(out), "--intrinsics", "60,60,31.5,23.5"]) == 0
    told = capsys.readouterr().out
    assert told.splitlines()[-5].startswith("Verdict: fh04 (GTRC ")
    # The refusal names the option that differs.
    assert main([*words, str(out), "--intrinsics", "61,60,31.5,23.5"]) == 2
    assert re.search(r"intrinsics is \[60.* there and \[61.* now", capsys.readouterr().err)
    # And so with a file: by its content, too.
    camera = tmp_path / "camera.txt"
    camera.write_text("60 0 31.5\n0 60 23.5\n0 0 1\n")
    words = [*words, str(tmp_path / "other"), "--calibration", str(camera)]
    assert main(words) == 0
    assert main(words) == 0
    camera.write_text("61 0 31.5\n0 60 23.5\n0 0 1\n")
    assert main(words) == 2
    assert re.search(r"options\.calibration is .* there and .*camera\.txt .* now", capsys.readouterr().err)


def test_a_file_in_place_of_the_folder_is_refused(
    lasting_frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.touch()
    assert main(["run", str(lasting_frames), "--out", str(file), "--no-report"]) == 2
    assert capsys.readouterr().err == f"nurbseg-eval: error: {file}: is a file; a folder is needed\n"
