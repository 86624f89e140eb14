"""The installed command, end to end, in processes of its own."""

import importlib.metadata
import json
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from program_in_terminal import terminal
from rendered import rendered

from nurbseg.app.live.opening import demo_uri
from nurbseg.app.view.viewer import viewer_executable
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.scoring.regions import Contingency
from tests.fakes.saved_view import read_saved_view

Live = Callable[..., subprocess.CompletedProcess[str]]

FAST = ("--speed", "0", "--view", "none")


def small(frames: int) -> str:
    return rendered(f"width=96&height=72&frames={frames}")


def test_help_is_printed_in_a_third_of_a_second(live_process: Live) -> None:
    def took_s() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert live_process("--help").returncode == 0
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    # Time on the processor, and the best of a few, because other programs run too.
    assert min(took_s() for _ in range(5)) < 0.3


def test_the_printed_configuration_can_be_fed_back(live_process: Live, tmp_path: Path) -> None:
    words = (
        "--metric",
        "vmxc",
        "--speed",
        "0.5",
        "--intrinsics",
        "1,2,3,4",
        "--view",
        "none",
        "--print-config",
    )
    first = live_process(*words)
    assert first.returncode == 0
    (tmp_path / "run.toml").write_text(first.stdout)
    second = live_process("--config", "run.toml", "--print-config")
    assert second.stdout == first.stdout
    assert 'metric = "vmxc"' in second.stdout


def test_depth_is_prepared_after_it_is_recorded_and_again_for_the_check(live: Live, tmp_path: Path) -> None:
    words = ("--crop", "30,20,50,40", "--depth-smoothing", "bilateral", "--fill-holes", "2")
    files = ("--record", "raw.mcap", "--export", "out", "--export-surfaces", "--report", "run.json")
    done = live("--replay", small(2), *FAST, *words, *files)
    assert done.returncode == 0, done.stderr
    with open_source(small(2)) as original, open_source(str(tmp_path / "raw.mcap")) as recorded:
        for _ in range(2):
            assert np.array_equal(recorded.read().depth_mm, original.read().depth_mm)
    labels = cv2.imread(str(tmp_path / "out" / "000001_labels.png"), cv2.IMREAD_UNCHANGED)
    rows, columns = np.nonzero(labels)
    # Filled by two pixels beyond the crop.
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (18, 61, 28, 81)
    settings = json.loads((tmp_path / "out" / "settings.json").read_text())["depth"]
    assert settings == json.loads((tmp_path / "run.json").read_text())["configuration"]["depth"]
    assert settings["crop"] == [30, 20, 50, 40]
    check = [sys.executable, "-m", "nurbseg.evaluation.eval_command", "check", "out", "--frames", small(2)]
    checked = subprocess.run(check, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert checked.returncode == 0, checked.stdout


def test_a_crop_outside_of_the_depth_image_is_refused(live: Live) -> None:
    done = live("--replay", small(2), *FAST, "--crop", "96,0,10,10", "--report", "run.json")
    assert done.returncode == 2
    assert "crop: (96, 0, 10, 10) is outside of a depth image of 96x72" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "words", [("--range-min", "60"), ("--workers", "2", "--temporal", "off", "--range-min", "60")]
)
def test_frames_whose_depth_is_all_lost_are_reported_once(live: Live, words: tuple[str, ...]) -> None:
    done = live("--replay", small(3), *FAST, *words)
    assert done.returncode == 0, done.stderr
    [line] = [line for line in done.stderr.splitlines() if "no pixel has depth" in line]
    assert line.startswith("nurbseg-live: warning: frame 0: ")
    for flag in ("--depth-scale", "--range-min", "--range-max", "--crop"):
        assert flag in line
    assert "no pixel has depth" not in live("--replay", small(1), *FAST).stderr


def test_version(live_process: Live) -> None:
    try:
        version = importlib.metadata.version("nurbseg")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("nurbseg is on the path, but not installed as a package")
    assert live_process("--version").stdout == f"nurbseg-live {version}\n"


def test_every_frame_of_a_recording_is_segmented_exported_and_reported(
    live_process: Live, tmp_path: Path
) -> None:
    done = live_process(
        "--replay", small(4), *FAST, "--export", "out", "--export-surfaces", "--report", "report.json"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    kinds = (
        *("labels.png", "objects.png"),
        *("surfaces.npz", "surfaces.png", "tree.json"),
    )
    assert names == [
        *(f"{index:06d}_{kind}" for index in range(4) for kind in kinds),
        "settings.json",
    ]
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["ended"] == "the source ended"
    assert report["recording"] is None
    assert (report["frames"]["read"], report["frames"]["segmented"]) == (4, 4)
    last = json.loads((tmp_path / "out/000003_tree.json").read_text())
    assert f"{len(last['objects'])} objects in the last" in done.stderr
    assert set(report["frames"]["dropped"].values()) == {0}
    assert set(report["latency_ms"]) >= {"wait", "register", "segment", "capture_to_labels", "export"}
    assert report["frames_per_s"] > 0


def test_files_of_a_live_tree_have_each_cut_measured_in_their_own_frame(live: Live, tmp_path: Path) -> None:
    source = ("--replay", rendered("width=160&height=120&frames=3"), "--speed", "0", "--temporal", "on")
    assert live(*source, "--view", "none", "--export", "out").returncode == 0
    for index in range(3):
        tree = json.loads((tmp_path / f"out/{index:06d}_tree.json").read_text())
        assert {segment["measured"] for segment in tree["segments"] if segment["division"] == "cut"} == {
            index
        }


def test_the_demo_recording_comes_apart_into_its_objects(live: Live, tmp_path: Path) -> None:
    demo = demo_uri()
    done = live("--replay", demo, *FAST, "--frames", "3", "--export", "out")
    assert done.returncode == 0, done.stderr
    with open_source(demo) as source:
        for index in range(3):
            truth = source.read().labels
            labels = cv2.imread(str(tmp_path / f"out/{index:06d}_labels.png"), cv2.IMREAD_UNCHANGED)
            assert Contingency.between(labels, truth).rand_index() > 0.95
            assert Contingency.between(labels, truth).region_covering() > 0.9


def test_the_same_seed_gives_the_same_files_and_another_gives_others(live: Live, tmp_path: Path) -> None:
    for folder, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert live("--replay", small(1), *FAST, "--seed", seed, "--export", folder).returncode == 0
    trees = [(tmp_path / folder / "000000_tree.json").read_bytes() for folder in "abc"]
    assert trees[0] == trees[1] != trees[2]


def test_a_paced_replay_drops_what_it_cannot_follow_and_says_so(live: Live, tmp_path: Path) -> None:
    done = live("--replay", small(60), "--speed", "20", "--view", "none", "--report", "report.json")
    assert done.returncode == 0, done.stderr
    frames = json.loads((tmp_path / "report.json").read_text())["frames"]
    assert frames["read"] == 60
    assert frames["segmented"] < 60
    assert frames["segmented"] + frames["dropped"]["overwritten_by_a_newer_frame"] == 60
    assert "missing from the results" not in done.stderr

    done = live("--replay", small(60), "--speed", "20", "--view", "none", "--export", "some")
    missing = 60 - len(list((tmp_path / "some").glob("*_tree.json")))
    assert (
        f"warning: {missing} of 60 frames are missing from the results: --speed 20 is too fast" in done.stderr
    )
    done = live("--replay", small(60), "--view", "none", "--export", "all")
    assert len(list((tmp_path / "all").glob("*_tree.json"))) == 60
    assert "missing" not in done.stderr


def test_an_address_where_no_page_can_be_served_is_named_and_nothing_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with terminal(["--replay", demo_uri(), "--bind", "192.0.2.1"], tmp_path) as program:
        program.wait_for("nurbseg-live: error: bind 192.0.2.1, port 9876: cannot listen there")
        assert program.exit_code() == 2
        assert "Traceback" not in program.all_said


def test_a_recording_that_is_deleted_while_it_is_replayed_is_read_to_its_end_and_named(
    start_live: Callable[..., Any], tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(Path(demo_uri()).read_bytes())
    run = start_live("--replay", str(path), "--view", "none", "--splits-max", "1", "--duration", "2")
    run.wait_for("frame 0")
    path.unlink()
    assert run.process.wait(60.0) == 0
    run.close()
    assert f"{path} was deleted or moved while it was replayed" in "".join(run.said)


def test_ctrl_c_ends_a_recording_which_is_then_reported(
    start_live: Callable[..., Any], tmp_path: Path
) -> None:
    words = ("--loop", "--view", "none", "--splits-max", "1", "--record", "a-{date}.mcap")
    run = start_live("--replay", demo_uri(), *words)
    run.wait_for("frame 0")
    code, _ = run.end_with(signal.SIGINT)
    run.close()
    assert code == 130
    (path,) = tmp_path.glob("a-*.mcap")
    assert time.strptime(path.stem, "a-%Y%m%d-%H%M%S") <= time.localtime()
    with open_source(str(path)) as source:
        stamps_ns = [frame.timestamp_ns for frame in source]
    size_mb = path.stat().st_size / 1e6
    seconds = (stamps_ns[-1] - stamps_ns[0]) / 1e9
    said = "".join(run.said)
    assert f"recorded {len(stamps_ns)} frames, {seconds:.1f} s, {size_mb:.1f} MB to {path.name}\n" in said
    assert re.search(r": \d+ frames? segmented", said)


def test_what_is_too_old_is_not_saved_and_counted(live: Live, tmp_path: Path) -> None:
    words = ("--replay", small(15), "--view", "none", "--report", "report.json")
    done = live(*words, "--speed", "1", "--set", "age_max_ms=0.001", "--export", "out", "--save", "a.rrd")
    assert done.returncode == 0, done.stderr
    frames = json.loads((tmp_path / "report.json").read_text())["frames"]
    shown = read_saved_view(tmp_path / "a.rrd", indexed=False).frames("tree")
    assert len(shown) == frames["segmented"] - frames["late"] < frames["segmented"]
    assert len(list((tmp_path / "out").glob("*_labels.png"))) == frames["segmented"]

    done = live(*words, "--speed", "0", "--set", "age_max_ms=0.001", "--save", "b.rrd", "--force")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "report.json").read_text())["frames"]["late"] == 0
    assert read_saved_view(tmp_path / "b.rrd").frames("tree") == list(range(15))


def test_limits_and_loops(live: Live, tmp_path: Path) -> None:
    done = live("--replay", small(3), *FAST, "--loop", "--frames", "5", "--export", "out")
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "out").glob("*_labels.png"))) == 5
    done = live("--replay", small(9), *FAST, "--duration", "0.1", "--export", "short")
    assert len(list((tmp_path / "short").glob("*_labels.png"))) == 3


def test_a_damaged_frame_is_named_and_the_run_continues(
    live: Live, write_pairs: Callable[..., Path], tmp_path: Path
) -> None:
    folder = write_pairs(4)
    (folder / "f1_depth.png").write_bytes((folder / "f1_depth.png").read_bytes()[:60])
    cv2.imwrite(str(folder / "f2_depth.png"), np.full((48, 64), 7, dtype=np.uint8))
    done = live("--replay", str(folder), *FAST, "--export", "out", "--report", "report.json")
    assert done.returncode == 0, done.stderr
    assert "f1_depth.png" in done.stderr
    assert "f2_depth.png" in done.stderr
    assert sorted(path.name[:6] for path in (tmp_path / "out").glob("*_labels.png")) == ["000000", "000003"]
    frames = json.loads((tmp_path / "report.json").read_text())["frames"]
    assert frames["dropped"]["damaged"] == 2
    assert len(frames["damaged_frames"]) == 2


@pytest.mark.parametrize(
    "values", [(0, 0), (1500, 1500)], ids=["no depth at all", "constant depth and color"]
)
def test_a_frame_without_content_is_a_result_too(
    values: tuple[int, int], live: Live, write_pairs: Callable[..., Path], tmp_path: Path
) -> None:
    folder = write_pairs(2)
    cv2.imwrite(str(folder / "f0_depth.png"), np.full((48, 64), values[0], dtype=np.uint16))
    cv2.imwrite(str(folder / "f0_color.png"), np.full((48, 64, 3), 99, dtype=np.uint8))
    done = live("--replay", str(folder), *FAST, "--export", "out")
    assert done.returncode == 0, done.stderr
    labels = cv2.imread(str(tmp_path / "out/000000_labels.png"), cv2.IMREAD_UNCHANGED)
    assert (labels.max() > 0) == (values[0] > 0)


def test_a_start_at_the_end_of_a_recording_is_named(live: Live, tmp_path: Path) -> None:
    done = live("--replay", small(2), *FAST, "--start", "2", "--report", "report.json")
    assert done.returncode == 1
    said = f"{small(2)}: no frame could be read after --start 2 (0 damaged)"
    assert f"nurbseg-live: error: {said}\n" in done.stderr
    assert json.loads((tmp_path / "report.json").read_text())["ended"] == said


def test_a_recording_without_a_usable_frame_is_refused(live: Live, write_pairs: Callable[..., Path]) -> None:
    folder = write_pairs(2)
    for path in folder.glob("*_depth.png"):
        path.write_bytes(b"not a picture")
    done = live("--replay", str(folder), *FAST)
    assert done.returncode == 2
    assert "_depth.png" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--replay", "none.mcap"), "none.mcap"),
        (("--replay", "."), "empty"),
        (("--device", "openni2:no-such-serial-0"), "nurbseg-devices doctor"),
        (("--replay", small(1), "--start", "9"), "--start 9"),
        (("--replay", small(1), "--report", "/proc/none/r.json"), "/proc/none/r.json"),
        (("--replay", small(1), "--export", "/proc/none"), "/proc/none"),
        (("--replay", small(1), "--calibration", "none.toml"), "none.toml"),
        (("--bogus",), "unrecognized arguments: --bogus"),
    ],
)
def test_what_cannot_begin_ends_with_2_and_a_plain_message(
    words: tuple[str, ...], complaint: str, live: Live, tmp_path: Path
) -> None:
    done = live(*words, "--view", "none")
    assert done.returncode == 2, done.stderr
    assert complaint in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("--save", ".", "--record", "a.mcap"),
        ("--save", "a.rrd", "--record", "/proc/none/a.mcap"),
        ("--save", "a.rrd", "--crop", "96,0,10,10"),
        ("--save", "a.rrd", "--workers", "2", "--temporal", "on"),
    ],
)
def test_a_run_that_cannot_begin_leaves_nothing_and_can_be_repeated(
    live: Live, tmp_path: Path, words: tuple[str, ...]
) -> None:
    said = set()
    for _ in range(2):
        done = live("--replay", small(1), *FAST, *words, "--report", "report.json")
        assert done.returncode == 2, done.stderr
        # Before it there may be a line that says that loops are compiled.
        said.add(done.stderr.splitlines()[-1])
        assert not list(tmp_path.iterdir())
    assert len(said) == 1


def test_a_run_that_lacks_a_library_leaves_nothing(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nurbseg.library.models.forms.find_spec", lambda name: None)
    words = ("--export", "out", "--export-cad", "step", "--report", "r.json", "--save", "a.rrd")
    for _ in range(2):
        done = live("--replay", small(1), *FAST, *words)
        assert done.returncode == 2, done.stderr
        assert "needs OCP" in done.stderr
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("taken", ["a.rrd", "a.mcap"])
def test_no_file_is_overwritten_and_none_is_begun_where_one_exists(
    live: Live, tmp_path: Path, taken: str
) -> None:
    (tmp_path / taken).write_bytes(b"precious")
    done = live("--replay", small(1), *FAST, "--save", "a.rrd", "--record", "a.mcap")
    assert done.returncode == 2, done.stderr
    assert f"{taken}: already exists; name another file or remove it" in done.stderr
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(taken, b"precious")]


def test_every_frame_that_is_only_recorded_is_counted(live: Live, tmp_path: Path) -> None:
    words = ("--speed", "0", "--record", "a.mcap", "--record-only", "--report", "a.json")
    done = live("--replay", small(7), *words)
    assert "done: 7 frames read" in done.stderr
    frames = json.loads((tmp_path / "a.json").read_text())["frames"]
    assert (frames["read"], frames["recorded_only"], any(frames["dropped"].values())) == (7, 7, False)


def test_results_reports_and_viewer_files_are_replaced_by_force_alone(live: Live, tmp_path: Path) -> None:
    base = ("--replay", small(1), *FAST)
    written = {"--export": "out", "--report": "r.json", "--save": "a.rrd"}
    every = [word for pair in written.items() for word in pair] + ["--export-objects", "--export-preview"]
    assert live(*base, *every).returncode == 0
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*[0-9]_*.*")}
    assert len(before) > 5
    for flag, name in written.items():
        taken = "out/000000_labels.png" if flag == "--export" else name
        content = (tmp_path / taken).read_bytes()
        done = live(*base, flag, name)
        assert done.returncode == (1 if flag == "--export" else 2)
        assert f"{taken}: already exists" in done.stderr
        assert "--force" in done.stderr
        assert (tmp_path / taken).read_bytes() == content
    assert {path: path.stat().st_mtime_ns for path in before} == before
    done = live(*base, *every, "--force")
    assert done.returncode == 0, done.stderr
    assert all(path.stat().st_mtime_ns > stamp for path, stamp in before.items())


def test_what_shows_the_cameras_images_is_for_this_user_alone(live_process: Live, tmp_path: Path) -> None:
    words = ("--save", "new/a.rrd", "--record", "other/a.mcap")
    done = live_process("--replay", small(2), *FAST, *words, umask=0)
    assert done.returncode == 0, done.stderr
    for name in ("new/a.rrd", "other/a.mcap"):
        assert (tmp_path / name).stat().st_mode & 0o777 == 0o600


def test_ctrl_c_before_anything_is_begun_ends_the_process_without_a_word() -> None:
    program = (
        "import os, signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name == 'nurbseg.app.command.live_command':\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from nurbseg.app.commands import live\n"
        "live()\n"
    )
    done = subprocess.run([sys.executable, "-c", program, "--help"], capture_output=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, b"", b"")


def test_an_unknown_key_ends_with_2_and_its_nearest_neighbour(live: Live, tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text("[segmentation]\nmetrik = 'mse'\n")
    done = live("--config", "run.toml")
    assert done.returncode == 2
    assert "run.toml: segmentation.metrik: no such setting (did you mean segmentation.metric?)" in done.stderr


def test_the_fallback_is_said_and_replayed(live: Live) -> None:
    done = live("--device", "openni2:no-such-serial-0", "--fallback", small(1), *FAST)
    assert done.returncode == 0, done.stderr
    assert "no camera found" in done.stderr
    assert f"replaying {small(1)} instead" in done.stderr


def test_a_full_disk_ends_with_1_and_says_what_is_kept(tmp_path: Path) -> None:
    words = [Path(sys.executable).with_name("nurbseg-live"), "--replay", small(3), *FAST, "--export", "out"]
    with subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None
        while "source: " not in run.stderr.readline():
            pass
        # Enough for the settings, too little for a frame.
        resource.prlimit(run.pid, resource.RLIMIT_FSIZE, (2400, 2400))
        text = run.communicate(timeout=60)[1]
    assert run.returncode == 1, text
    assert "cannot be written: File too large; the 0 previous frames are kept in out" in text
    assert "Traceback" not in text
    assert not list((tmp_path / "out").glob(".*"))


def test_a_disk_too_full_for_the_viewers_file_ends_with_1_and_does_not_hang(live: Live) -> None:
    done = live("--replay", small(60), "--speed", "0", "--view", "none", "--save", "/dev/full")
    assert done.returncode == 1, done.stderr
    assert "/dev/full: cannot be written: No space left on device" in done.stderr
    assert "Traceback" not in done.stderr
    done = live("--replay", small(60), *FAST, "--save", "/dev/full", "--export", "out")
    assert done.returncode == 1, done.stderr
    assert "nothing more is shown or saved, but the run goes on" in done.stderr


def test_quiet_says_nothing_and_verbose_every_frame(live: Live) -> None:
    quiet = live("--replay", small(2), *FAST, "--quiet")
    assert (quiet.returncode, quiet.stderr) == (0, "")
    verbose = live("--replay", small(3), *FAST, "--verbose")
    assert [verbose.stderr.count(f"frame {index}:") for index in range(3)] == [1, 1, 1]


@pytest.mark.parametrize(
    ("words", "has_index"),
    [(["--speed", "0"], True), (["--speed", "1"], False), (["--speed", "1", "--set", "save_index=on"], True)],
)
def test_a_live_run_saves_without_an_index(
    live: Live, tmp_path: Path, words: list[str], has_index: bool
) -> None:
    path = tmp_path / "saved.rrd"
    source = rendered("width=160&height=120&frames=3")
    done = live("--replay", source, "--view", "none", "--save", str(path), *words)
    assert done.returncode == 0, done.stderr
    assert "footer" not in done.stderr
    verified = subprocess.run(
        [viewer_executable(), "rrd", "verify", path], capture_output=True, text=True, timeout=60
    )
    assert (verified.returncode == 0) == has_index, verified.stderr
    assert has_index or "Missing RRD footer" in verified.stderr
    assert read_saved_view(path, indexed=has_index).frames("world/camera/image/depth")


# In real time a busy computer drops most frames, but not all of three seconds.
@pytest.mark.parametrize(("speed", "frames"), [("0", 3), ("1", 90)])
def test_a_live_run_shows_surfaces_and_lists_objects_only_as_often_as_they_are_seen(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speed: str, frames: int
) -> None:
    path = tmp_path / "saved.rrd"
    monkeypatch.setattr("nurbseg.app.view.isolated._IN_FULL_S", 60.0)
    source = rendered(f"width=160&height=120&frames={frames}")
    done = live("--replay", source, "--speed", speed, "--view", "none", "--save", str(path))
    assert done.returncode == 0, done.stderr
    saved = read_saved_view(path, indexed=speed == "0")
    shown = saved.frames("splits")
    assert len(shown) > 1
    in_full = shown if speed == "0" else shown[:1]
    assert saved.frames("objects") == saved.frames("world/surfaces") == in_full


def test_in_a_pause_every_frame_that_is_shown_has_its_table_of_objects(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nurbseg.app.view.isolated._IN_FULL_S", 60.0)
    # More steps than there are frames, so that the run ends.
    (tmp_path / "commands").write_text("metric mae\npause\n" + 5 * "step\n")
    with (tmp_path / "commands").open() as commands:
        monkeypatch.setattr("sys.stdin", commands)
        source = rendered("width=96&height=72&frames=3")
        done = live("--replay", source, "--view", "none", "--save", "a.rrd", "--control", "lines")
    assert done.returncode == 0, done.stderr
    saved = read_saved_view(tmp_path / "a.rrd", indexed=False)
    assert saved.frames("objects") == saved.frames("splits")
    assert len(saved.frames("objects")) > 1
    # The metric that was chosen in between is the one that is listed.
    assert "| MAE (m) |" in saved.by_frame["splits"]["TextDocument:text"][0][0]
