"""The command over recordings that are whole, broken and begun."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rendered import rendered

from nurbseg.app.batch.batch import PROGRESS_FILE, recordings_of, run_batch
from nurbseg.app.batch.batch_command import main
from nurbseg.app.command.live_command import main as live_main
from nurbseg.app.settings.output_config import ExportConfig
from nurbseg.app.workers import WorkerLostError, Workers, open_workers
from nurbseg.common.frame import Calibration, Intrinsics
from nurbseg.drivers.calibration.file import write_calibration
from nurbseg.drivers.options import SourceOptions
from nurbseg.evaluation.eval_command import main as eval_main
from nurbseg.segmentation.config import SegmentationConfig

Pairs = Callable[..., Path]

#: Settings, options and files of a batch without flags.
PLAIN = SegmentationConfig(), SourceOptions(), ExportConfig()


def results(folder: Path) -> dict[str, bytes]:
    """Return the files of an export, but for what says where it came from and how far it is."""
    return {path.name: path.read_bytes() for path in folder.glob("0*")}


def report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


def batch(*words: str, workers: str = "1") -> int:
    return main([*words, "--export", "out", "--workers", workers])


@pytest.fixture
def at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in an empty folder, so that recordings have short names."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_recordings_give_what_the_live_command_gives_for_each(at_home: Path, write_pairs: Pairs) -> None:
    write_pairs(20, name="one")
    write_pairs(2, name="two")
    forms = ["--export-surfaces", "--export-mesh", "ply"]
    assert batch("one", "two", *forms, workers="2") == 0
    for name, frames in (("one", 20), ("two", 2)):
        words = ["--replay", name, "--speed", "0", "--view", "none", "--quiet", *forms]
        assert live_main([*words, "--export", f"live-{name}"]) == 0
        alone = results(at_home / f"live-{name}")
        assert len([path for path in alone if path.endswith("_tree.json")]) == frames
        assert results(at_home / "out" / name) == alone
    told = report(at_home / "out")
    assert (told["ended"], told["complete"], told["failed"], told["segmented"]) == ("done", 2, 0, 22)
    assert told["bytes_per_frame"] * 22 == pytest.approx(
        sum(len(result) for name in ("one", "two") for result in results(at_home / "out" / name).values()),
        rel=0.01,
    )


def test_what_is_done_is_not_done_again(at_home: Path, write_pairs: Pairs) -> None:
    write_pairs(3, name="one")
    assert batch("one") == 0
    before = {path: path.stat().st_mtime_ns for path in (at_home / "out" / "one").glob("0*")}
    shutil.rmtree("one")
    write_pairs(2, name="two")
    assert batch("one", "two") == 0
    assert {path: path.stat().st_mtime_ns for path in (at_home / "out" / "one").glob("0*")} == before
    assert [recording["segmented"] for recording in report(at_home / "out")["recordings"]] == [0, 2]


def test_broken_recordings_do_not_stop_the_others_and_are_listed_at_the_end(
    at_home: Path, write_pairs: Pairs, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pairs(2, name="good")
    Path("cut.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\0" * 20)
    Path("empty").mkdir()
    assert batch("cut.mcap", "empty", "nowhere", "good") == 1
    listed = capsys.readouterr().err.partition("3 of 4 recordings failed:")[2]
    named = [line.split(":")[0].strip() for line in listed.strip().splitlines()]
    assert named == ["cut.mcap", "empty", "nowhere"]
    assert listed.count("nowhere") == 1
    assert sorted(path.name for path in (at_home / "out").iterdir()) == ["good", "report.json"]
    assert "no such file or folder" in listed
    told = report(at_home / "out")
    assert (told["ended"], told["complete"], told["failed"]) == ("done", 1, 3)
    assert len(list((at_home / "out" / "good").glob("*_tree.json"))) == 2


def test_a_damaged_frame_costs_itself_alone_and_is_named(at_home: Path, write_pairs: Pairs) -> None:
    write_pairs(4, name="one")
    damaged = Path("one/f1_depth.png")
    damaged.write_bytes(damaged.read_bytes()[:60])
    assert batch("one") == 0
    [told] = report(at_home / "out")["recordings"]
    assert (told["done"], told["segmented"], list(told["damaged"])) == (4, 3, ["1"])
    assert "f1_depth.png" in told["damaged"]["1"]


def test_a_recording_that_changed_meanwhile_is_refused(at_home: Path, write_pairs: Pairs) -> None:
    write_pairs(4, name="one")
    assert batch("one") == 0
    progress = at_home / "out" / "one" / PROGRESS_FILE
    progress.write_text(json.dumps({"frames": 9, "done": 3, "damaged": {}}))
    assert batch("one") == 1
    assert "has 4 frames, but had 9" in report(at_home / "out")["recordings"][0]["failure"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[" * 100_000, "cannot be read: .*"),
        ("[]", "cannot be read: expected a JSON object"),
        ('{"frames": 1e999, "done": 3, "damaged": {}}', "done: expected a number of frames, got 3 of inf"),
        ('{"frames": 4, "done": 5, "damaged": {}}', "done: expected a number of frames, got 5 of 4"),
        ('{"frames": 4, "done": -1, "damaged": {}}', "done: expected a number of frames, got -1 of 4"),
        ('{"frames": 4, "done": 4, "damaged": 7}', "damaged: expected an object, got 7"),
        ('{"frames": 4, "done": 4}', "damaged: expected an object, got None"),
    ],
)
def test_progress_that_cannot_be_is_named(at_home: Path, write_pairs: Pairs, content: str, said: str) -> None:
    write_pairs(4, name="one")
    (at_home / "out" / "one").mkdir(parents=True)
    (at_home / "out" / "one" / PROGRESS_FILE).write_text(content)
    assert batch("one") == 1
    failure = report(at_home / "out")["recordings"][0]["failure"]
    assert re.fullmatch(rf".*one/progress\.json: {said}; delete .*out/one to start over", failure)


def test_other_settings_are_refused(at_home: Path, write_pairs: Pairs) -> None:
    write_pairs(1, name="one")
    assert batch("one") == 0
    assert batch("one", "--set", "metric=mae") == 1
    assert "metric is mse there and mae now" in report(at_home / "out")["recordings"][0]["failure"]


def test_other_cameras_are_refused_while_the_recording_is_there(at_home: Path, write_pairs: Pairs) -> None:
    write_pairs(1, name="one")
    assert batch("one") == 0
    other = ["one", "--intrinsics", "77,77,20,20"]
    assert batch(*other) == 1
    failure = report(at_home / "out")["recordings"][0]["failure"]
    assert re.search(r"camera\.depth\.fx is [\d.]+ there and 77\.0 now", failure)
    shutil.rmtree("one")
    assert batch(*other) == 0


def test_cameras_of_a_file_are_those_of_all_recordings_and_a_missing_file_is_named_once(
    at_home: Path, write_pairs: Pairs, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("one", "two"):
        write_pairs(1, name=name)
    words = ["one", "two", "--calibration", "camera.toml"]
    assert batch(*words, workers="2") == 2
    assert capsys.readouterr().err.count("camera.toml") == 1
    camera = Intrinsics(64, 48, 77.0, 78.0, 31.0, 23.0)
    write_calibration(Path("camera.toml"), Calibration.registered(camera))
    assert batch(*words, workers="2") == 0
    for name in ("one", "two"):
        settings = json.loads((at_home / "out" / name / "settings.json").read_text())
        assert settings["camera"]["depth"]["fy"] / settings["camera"]["depth"]["fx"] == 78.0 / 77.0


def test_frames_without_depth_are_counted(
    at_home: Path, write_pairs: Pairs, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pairs(3, name="one")
    for number in (0, 2):
        path = f"one/f{number}_depth.png"
        cv2.imwrite(path, np.zeros_like(cv2.imread(path, cv2.IMREAD_UNCHANGED)))
    for _ in range(2):
        assert batch("one") == 0
        assert "2 without depth (check --depth-scale): out/one" in capsys.readouterr().err
    assert report(at_home / "out")["recordings"][0]["without_depth"] == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a", "--workers", "none"], "--workers none: expected a number"),
        (["a", "../a"], "a, ../a: both would write results to out/a"),
        (["a", "--set", "metric=none"], "metric"),
        (["a", "--scheduler", "tcp://127.0.0.1:9"], "no Dask scheduler answers there"),
    ],
)
def test_wrong_arguments_end_with_2_and_name_themselves(
    at_home: Path,
    words: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("nurbseg.app.workers._SCHEDULER_TIMEOUT_S", 0.2)
    assert main([*words, "--export", "out"]) == 2
    assert said in capsys.readouterr().err


def test_a_file_in_place_of_the_folder_is_refused(at_home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").touch()
    assert main(["a", "--export", "out"]) == 2
    assert capsys.readouterr().err == "nurbseg-batch: error: out: is a file; a folder is needed\n"


@pytest.mark.filterwarnings("default")
def test_a_dask_cluster_gives_the_same_files(at_home: Path, write_pairs: Pairs) -> None:
    distributed = pytest.importorskip("distributed")
    folder = str(write_pairs(20, name="one"))
    assert main([folder, "--export", "alone", "--workers", "1"]) == 0
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        assert main([folder, "--export", "shared", "--scheduler", cluster.scheduler_address]) == 0
    alone, shared = (results(Path(name, *Path(folder).parts[1:])) for name in ("alone", "shared"))
    assert len(alone) >= 40
    assert shared == alone


def test_a_killed_run_of_real_recordings_continues_where_it_was(
    at_home: Path, real_data: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    kitchen = real_data("kitchen_sequence")
    for name, frames in (("a", range(100, 110)), ("b", range(110, 120))):
        Path(name).mkdir()
        Path(name, "camera-intrinsics.txt").write_text("146 0 79.5\n0 146 59.5\n0 0 1\n")
        for frame in frames:
            for kind in ("color.jpg", "depth.png"):
                image = cv2.imread(f"{kitchen}/frame-{frame:06d}.{kind}", cv2.IMREAD_UNCHANGED)[::4, ::4]
                cv2.imwrite(f"{name}/frame-{frame:06d}.{kind[:5]}.png", np.ascontiguousarray(image))
    words = ["a", "b", "--export-surfaces", "--workers", "2"]
    assert main([*words, "--export", "whole"]) == 0
    command = Path(sys.executable).with_name("nurbseg-batch")
    process = subprocess.Popen([command, *words, "--export", "out"])
    limit_s = time.monotonic() + 200
    while not Path("out/a", PROGRESS_FILE).exists():
        assert process.poll() is None
        assert time.monotonic() < limit_s
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(10)
    finished = {path: path.stat().st_mtime_ns for path in Path("out/a").glob("0*")}
    done = json.loads(Path("out/a", PROGRESS_FILE).read_text())["done"]
    assert 0 < done <= 10
    assert main([*words, "--export", "out"]) == 0
    for name in ("a", "b"):
        assert results(Path("out", name)) == results(Path("whole", name))
    kept = {path: path.stat().st_mtime_ns for path in Path("out/a").glob("0*") if int(path.name[:6]) < done}
    assert kept.items() <= finished.items(), "finished frames were done again"
    assert len(kept) == 5 * done
    for name in ("a", "b"):
        assert eval_main(["check", f"out/{name}", "--frames", name]) == 0, capsys.readouterr()


class WaitedFor(Future):
    """Is not done before it is waited for."""

    def done(self) -> bool:
        return False


class FailingWorkers:
    """Give every frame the same file, but fail with one of the tasks."""

    def __init__(self, failing: int) -> None:
        self._failing = failing

    def submit(self, function: Callable, task: Any, /) -> Future:
        future, (run, _) = WaitedFor(), task
        if run.start == self._failing:
            future.set_exception(WorkerLostError("gone"))
        else:
            future.set_result([({f"{place:06d}_tree.json": b"{}"}, True) for place in run])
        return future

    def ahead(self) -> int:
        return 3


def unread(frames: int) -> str:
    """A recording whose images do not matter: no worker reads them."""
    return rendered(f"width=32&height=24&frames={frames}")


def test_a_recording_that_fails_midway_is_whole_up_to_there(tmp_path: Path) -> None:
    recordings = recordings_of([unread(60), unread(10)], tmp_path)
    told: list[str] = []
    run_batch(recordings, FailingWorkers(16), *PLAIN, lambda each: told.append(each.uri))
    failed, whole = recordings
    assert failed.failure == "frames 16 to 19: gone"
    assert (failed.done, whole.done, whole.failure) == (16, 10, "")
    assert sorted(results(Path(failed.directory))) == [f"{place:06d}_tree.json" for place in range(16)]
    assert told == [unread(60), unread(10)]


def test_a_recording_that_becomes_shorter_fails_at_its_end(at_home: Path, write_pairs: Pairs) -> None:
    folder = write_pairs(10, name="one")
    recordings = recordings_of(["one"], at_home / "out")

    def submit(function: Callable, task: Any) -> Future:
        for path in [*folder.glob("f[6-9]_*")]:
            path.unlink()
        return workers.submit(function, task)

    with open_workers(1) as workers:
        run_batch(recordings, Workers(submit, workers.ahead), *PLAIN)
    assert recordings[0].failure == "frames 4 to 7: one: ends after 6 frames"
    assert len(list(Path("out/one").glob("*_tree.json"))) == recordings[0].done == 4


def test_a_recording_that_fails_at_its_first_frame_leaves_no_folder(tmp_path: Path) -> None:
    recordings = recordings_of([unread(20)], tmp_path)
    run_batch(recordings, FailingWorkers(0), *PLAIN)
    assert "frames 0 to 3: gone" in recordings[0].failure
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_batch_that_is_ended_reports_how_far_it_came(at_home: Path, number: int) -> None:
    command = Path(sys.executable).with_name("nurbseg-batch")
    Path("scene.mcap").symlink_to(rendered("width=96&height=72&frames=900"))
    words = ["scene.mcap", "--export", "out", "--workers", "2"]
    process = subprocess.Popen([command, *words], stderr=subprocess.PIPE, text=True)
    limit_s = time.monotonic() + 200
    while not list(Path("out").glob(f"*/{PROGRESS_FILE}")):
        assert process.poll() is None
        assert time.monotonic() < limit_s
        time.sleep(0.01)
    process.send_signal(number)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert told.endswith("nurbseg-batch: interrupted; run the same command to resume\n")
    assert report(at_home / "out")["ended"] == "interrupted"
    assert not list(Path("out").rglob("*.part"))


@pytest.mark.parametrize("name", ["settings.json", "000006_tree.json", PROGRESS_FILE])
def test_a_signal_right_after_a_file_was_opened_leaves_nothing_unfinished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    opened = os.open

    def interrupted(path: Any, *how: Any, **more: Any) -> int:
        descriptor = opened(path, *how, **more)
        if Path(path).match(f".{name}.*.part"):
            os.close(descriptor)
            raise KeyboardInterrupt
        return descriptor

    def run() -> set[str]:
        with suppress(KeyboardInterrupt):
            run_batch(recordings_of([unread(10)], tmp_path), FailingWorkers(-1), *PLAIN)
        return {path.name for path in tmp_path.rglob("*") if path.is_file()}

    with monkeypatch.context() as patches:
        patches.setattr(os, "open", interrupted)
        left = run()
    complete = {f"{place:06d}_tree.json" for place in range(10)} | {"settings.json", PROGRESS_FILE}
    # Neither this file nor one of another name, and the next run writes the rest.
    assert left <= complete - {name}
    assert run() >= complete
