"""nurbseg-live on a virtual camera that is a real OpenNI2 driver: captured, recorded, unplugged, absent."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from busy_computer import slowdowns
from fair_clock import FairClock
from virtual_camera import color_image, depth_image, frame_number, openni2_redist, virtual_cameras

from nurbseg.common.errors import EndOfRecordingError
from nurbseg.drivers.registry import open_source

__all__ = ["openni2_redist", "virtual_cameras"]

NO_VIEW = ["--view", "none"]
LIVE = [sys.executable, "-m", "nurbseg.app.command.live_command", *NO_VIEW]
#: Fast settings: what is tested here is not the segmentation.
FAST = ["--splits-max", "1", "--decimation", "8"]


def start(*words):
    return subprocess.Popen([*LIVE, *words], stderr=subprocess.PIPE, text=True)


def wait_for_line(process, words, limit_s=60.0):
    """Return the first line on stderr that holds these words."""
    seen = []
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline and (line := process.stderr.readline()):
        seen.append(line)
        if words in line:
            return line
    raise AssertionError(f"no {words!r} in {''.join(seen)!r}")


def frames_of(path):
    frames = []
    with open_source(path) as source:
        while True:
            try:
                frames.append(source.read(timeout_s=30.0))
            except EndOfRecordingError:
                return frames


def assert_exact(frames, *, exact_color=True, whole=True):
    """Hold recorded frames against what the camera showed, and each other's numbers where none is missed."""
    numbers = [frame_number(frame) for frame in frames]
    steps = np.diff(numbers)
    assert (steps == 1).all() if whole else (steps >= 1).all()
    for number, frame in zip(numbers, frames, strict=True):
        assert np.array_equal(frame.depth_mm, depth_image(number))
        if exact_color:
            assert np.array_equal(frame.color, color_image(number))


def recorded_without_a_miss(camera, tmp_path, color):
    """Record 300 frames while they are segmented; return the report of a run that missed none.

    Other programs on the computer may take the processor away for longer than frames wait. Then the
    report must say so, and the run is made again, with a slower camera.
    """
    for attempt, slowdown in enumerate(slowdowns()):
        camera.set(slowdown=slowdown)
        report = tmp_path / f"R{attempt}.json"
        words = ["--device", "openni2:any", "--frames", "300", "--report", str(report)]
        words += ["--record", str(tmp_path / f"X{attempt}.mcap"), "--record-color", color]
        done = subprocess.run(
            [*LIVE, *words],
            capture_output=True,
            text=True,
            timeout=240 + 60 * slowdown,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        document = json.loads(report.read_text())
        frames = document["frames"]
        assert frames["read"] == 300
        assert frames["segmented"] >= 1
        assert frames["segmented"] + sum(frames["dropped"].values()) == 300
        if frames["camera"] == {"missed": 0, "half_pairs": 0, "reconnections": 0}:
            return document
    raise AssertionError(f"frames were missed in each run: {frames}")


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("color", ["raw", "png"])
def test_300_recorded_frames_are_exact_while_they_are_segmented(virtual_cameras, tmp_path, color):
    document = recorded_without_a_miss(virtual_cameras.add(), tmp_path, color)
    assert document["source"]["serial"] == "VC0001"
    assert (document["recording"]["frames"], document["recording"]["lost"]) == (300, 0)
    frames = frames_of(Path(document["recording"]["file"]))
    assert len(frames) == 300
    assert_exact(frames)


def test_color_is_jpeg_by_default_and_depth_always_exact(live, virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "X.mcap"
    assert (
        live(*NO_VIEW, "--device", "any", "--frames", "30", "--record", str(path), "--record-only").returncode
        == 0
    )
    frames = frames_of(path)
    assert len(frames) == 30
    assert_exact(frames, exact_color=False, whole=False)


def test_the_count_begins_after_the_delay(live, virtual_cameras, tmp_path):
    virtual_cameras.add()
    path, report = tmp_path / "X.mcap", tmp_path / "R.json"
    words = ["--device", "any", "--frames", "30", "--record", str(path), "--record-delay", "1"]
    done = live(*NO_VIEW, *words, "--record-only", "--report", str(report))
    assert done.returncode == 0, done.stderr
    document = json.loads(report.read_text())
    assert document["recording"]["frames"] == 30
    # Frames that a busy computer misses passed by as well.
    assert document["frames"]["read"] + document["frames"]["camera"]["missed"] >= 59
    assert document["frames"]["segmented"] == 0
    assert len(frames_of(path)) == 30


def test_duration_counts_from_the_delay_too(live, virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "X.mcap"
    words = ["--device", "any", "--duration", "1", "--record", str(path), "--record-delay", "0.5"]
    assert live(*NO_VIEW, *words, "--record-only").returncode == 0
    frames = frames_of(path)
    assert 0.8 < (frames[-1].timestamp_ns - frames[0].timestamp_ns) * 1e-9 < 1.0


def test_ctrl_c_leaves_a_whole_recording(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path = tmp_path / "X.mcap"
    with start("--device", "any", "--record", str(path), *FAST) as process:
        wait_for_line(process, "segments in")
        time.sleep(1.0)
        with FairClock(process.pid) as clock:
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
        assert clock.elapsed_s < 2.5
    assert len(frames_of(path)) >= 20


def test_recordings_begin_and_end_by_commands_while_the_camera_continues(virtual_cameras, tmp_path):
    virtual_cameras.add()
    path, report = tmp_path / "X.mcap", tmp_path / "R.json"
    words = ["--device", "any", "--record", str(path), "--report", str(report), "--control", "lines", *FAST]
    process = subprocess.Popen(
        [*LIVE, *words], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
    )
    with process:
        wait_for_line(process, "segments in")
        for command, said in (
            ("record off", f"to {path}"),
            ("record on", "recording to"),
            ("", ""),
            ("record off", f"to {tmp_path / 'X-2'}"),
            ("record on", "recording to"),
            ("", ""),
            ("quit", f"to {tmp_path / 'X-3'}"),
        ):
            if command:
                process.stdin.write(f"{command}\n")
                wait_for_line(process, said)
            else:
                time.sleep(1.0)
        assert process.wait(60) == 0
    document = json.loads(report.read_text())
    recordings = [*document["earlier_recordings"], document["recording"]]
    files = [path, tmp_path / "X-2.mcap", tmp_path / "X-3.mcap"]
    assert [recording["file"] for recording in recordings] == [str(file) for file in files]
    counts = [recording["frames"] for recording in recordings]
    found = [frames_of(file) for file in files]
    assert [len(frames) for frames in found] == counts
    for frames in found:
        assert_exact(frames, exact_color=False, whole=False)
    assert min(counts[1:]) >= 5
    assert document["frames"]["read"] > sum(counts)


def test_a_disk_that_fills_up_ends_a_recording_with_a_readable_file(virtual_cameras, tmp_path, monkeypatch):
    virtual_cameras.add()
    path = tmp_path / "X.mcap"
    # For the source process, which writes the file.
    (tmp_path / "sitecustomize.py").write_text(
        "import itertools, shutil, types\n"
        "left = itertools.chain([10**12] * 16, itertools.repeat(10**6))\n"
        "shutil.disk_usage = lambda path: types.SimpleNamespace(free=next(left))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    words = ["--device", "any", "--record", str(path), "--record-only"]
    done = subprocess.run([*LIVE, *words], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "recording stopped: only 1 MB of disk space are left" in done.stderr
    frames = frames_of(path)
    assert len(frames) == 15
    assert_exact(frames, exact_color=False, whole=False)


def test_unplugged_and_plugged_in_again_the_run_and_its_recording_go_on(virtual_cameras, tmp_path):
    camera = virtual_cameras.add()
    path = tmp_path / "X.mcap"
    with start("--device", "any", "--record", str(path), "--frames", "90", *FAST) as process:
        wait_for_line(process, "segments in")
        camera.unplug()
        wait_for_line(process, "waiting for it to come back")
        camera.plug()
        wait_for_line(process, "is back")
        assert process.wait(60) == 0
    frames = frames_of(path)
    assert len(frames) == 90
    assert min(np.diff([frame.timestamp_ns for frame in frames])) > 0


def test_unplugged_without_reconnecting_the_run_ends_with_what_was_recorded(virtual_cameras, tmp_path):
    camera = virtual_cameras.add()
    path = tmp_path / "X.mcap"
    with start("--device", "any", "--record", str(path), "--no-reconnect", *FAST) as process:
        wait_for_line(process, "segments in")
        camera.unplug()
        assert process.wait(60) == 1
    assert len(frames_of(path)) >= 1


def test_the_cameras_settings_are_flags(live, virtual_cameras, tmp_path):
    virtual_cameras.add("one", serial="S1")
    virtual_cameras.add("two", serial="S2")
    path, report = tmp_path / "X.mcap", tmp_path / "R.json"
    done = live(
        *NO_VIEW,
        *("--device", "xtion", "--serial", "S2", "--depth-mode", "320x240@60", "--color-mode", "qvga"),
        *("--mirror", "--registration", "software", "--no-sync", "--frames", "10"),
        *("--record", str(path), "--record-only", "--report", str(report)),
    )
    assert done.returncode == 0, done.stderr
    source = json.loads(report.read_text())["source"]
    assert (source["serial"], source["mirror"], source["sync"]) == ("S2", "on", "off")
    assert source["registration"] == "software"
    for frame in frames_of(path):
        number = frame_number(frame, fps=60)
        expected = depth_image(number, 320, 240, registered=False, mirrored=True)
        assert np.array_equal(frame.depth_mm, expected)


def test_a_mode_that_the_camera_does_not_have_is_refused_with_those_it_has(live, virtual_cameras):
    virtual_cameras.add()
    done = live(*NO_VIEW, "--device", "any", "--depth-mode", "800x600@30")
    assert done.returncode == 2
    assert "640x480@30" in done.stderr


def test_without_a_camera_the_doctors_finding_is_printed(live, virtual_cameras):
    done = live(*NO_VIEW, "--device", "xtion")
    assert done.returncode == 2
    assert "no such camera" in done.stderr
    # Which finding it is depends on the computer; each names what to do next.
    assert "nurbseg-devices doctor" in done.stderr.splitlines()[-1]
    assert len(done.stderr.splitlines()) >= 2


def test_without_a_camera_the_fallback_is_replayed(live, virtual_cameras, tmp_path):
    camera = virtual_cameras.add()
    path = tmp_path / "X.mcap"
    assert (
        live(*NO_VIEW, "--device", "any", "--frames", "5", "--record", str(path), "--record-only").returncode
        == 0
    )
    camera.unplug()
    done = live(*NO_VIEW, "--device", "xtion", "--fallback", str(path), "--speed", "0", *FAST)
    assert done.returncode == 0, done.stderr
    assert "replaying" in done.stderr
    assert "5 frames segmented" in done.stderr


def test_one_damaged_image_costs_one_frame_of_a_run(live, virtual_cameras, tmp_path):
    virtual_cameras.add(short_depth="15")
    path, report = tmp_path / "X.mcap", tmp_path / "R.json"
    words = ["--device", "any", "--frames", "40", "--record", str(path), "--record-only"]
    done = live(*NO_VIEW, *words, "--report", str(report))
    assert done.returncode == 0, done.stderr
    frames = frames_of(path)
    assert_exact(frames, exact_color=False, whole=False)
    assert len(frames) == 40
    assert 15 not in [frame_number(frame) for frame in frames]
    counts = json.loads(report.read_text())["frames"]
    assert counts["dropped"]["damaged"] == 1
    assert counts["damaged_frames"][0].startswith("depth frame 16: 640x480")
    assert "skipped a damaged frame: depth frame 16" in done.stderr


def test_a_run_outlasts_a_time_of_damaged_images(live, virtual_cameras, tmp_path):
    """They end when the camera is reopened."""
    camera = virtual_cameras.add(short_color="45-")
    path, report = tmp_path / "X.mcap", tmp_path / "R.json"
    words = ["--device", "any", "--record", str(path), "--record-only", "--report", str(report)]
    with start(*words, "--set", "silence_limit_s=0.5", "--frames", "60") as process:
        wait_for_line(process, "waiting for it to come back")
        camera.set(short_color="0-5")
        said = wait_for_line(process, "frames resume")
        assert process.wait(60) == 0, said
    counts = json.loads(report.read_text())["frames"]
    assert counts["camera"]["reconnections"] >= 1
    assert 10 < counts["dropped"]["damaged"] < 200
    assert len(frames_of(path)) == 60


@pytest.mark.parametrize(("words", "code"), [([], 0), (["--save", "X.rrd"], 1)])
def test_a_recording_outlives_the_process_that_shows(virtual_cameras, tmp_path, monkeypatch, words, code):
    virtual_cameras.add()
    monkeypatch.chdir(tmp_path)
    served = ["--view", "serve", "--port", "0", "--web-port", "0", "--control", "off"]
    recorded = ["--device", "any", "--record", "X.mcap", "--frames", "90", "--report", "R.json"]
    command = [*LIVE, *served, *recorded, *words, *FAST]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        wait_for_line(process, "segments in")
        children = psutil.Process(process.pid).children()
        (shows,) = [child for child in children if "nurbseg.app.view.program" in child.cmdline()]
        shows.kill()
        wait_for_line(process, "but the run goes on")
        said = process.stderr.read()
        assert process.wait(60) == code, said
    assert len(frames_of(tmp_path / "X.mcap")) == 90
    report = json.loads((tmp_path / "R.json").read_text())
    assert report["ended"] == "the source ended"
    assert report["view_failure"] == "the view process ended by signal 9"


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL])
def test_a_recording_misses_no_frame_while_the_segmentation_is_stopped_or_killed(
    virtual_cameras, tmp_path, how
):
    camera = virtual_cameras.add()
    for attempt, slowdown in enumerate(slowdowns()):
        camera.set(slowdown=slowdown)
        path = tmp_path / f"{attempt}.mcap"
        with start("--device", "any", "--record", str(path), "--record-color", "raw", *FAST) as run:
            wait_for_line(run, "frame 0")
            (source,) = psutil.Process(run.pid).children()
            time.sleep(1.0 * slowdown)
            run.send_signal(how)
            if how == signal.SIGSTOP:
                time.sleep(5.0 * slowdown)
                run.send_signal(signal.SIGCONT)
                run.send_signal(signal.SIGINT)
            source.wait(10.0)
        with open_source(path) as recording:
            assert recording.metadata["whole"] == "true"
        numbers = [frame_number(frame) for frame in frames_of(path)]
        assert len(numbers) > (100 if how == signal.SIGSTOP else 10)
        # Another program may have taken the core of the source process.
        if (np.diff(numbers) == 1).all():
            return
    raise AssertionError(f"frames were missed in each run: {np.diff(numbers).tolist()}")
