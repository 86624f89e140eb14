import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from plugged_usb import KINECT_CAMERA, KINECT_MOTOR, XTION, FakeRoot, Plugged
from virtual_camera import openni2_redist, virtual_cameras

from nurbseg.app.devices import devices_command as devices
from nurbseg.app.devices import probe as device_probe
from nurbseg.app.devices import report as device_report
from nurbseg.common.errors import DriverError
from nurbseg.drivers.calibration.file import read_camera_file
from nurbseg.drivers.doctor import camera_list
from nurbseg.drivers.doctor.diagnosis import describe, diagnose
from nurbseg.drivers.realsense.device import RealSenseSource

__all__ = ["openni2_redist", "virtual_cameras"]


def command(*words, **environment):
    return subprocess.run(
        [sys.executable, "-m", "nurbseg.app.devices.devices_command", *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=os.environ | environment,
    )


def test_help_names_every_subject():
    done = command("--help")
    assert done.returncode == 0
    assert all(word in done.stdout for word in ("doctor", "list", "calibration"))


def test_help_needs_no_numpy():
    code = (
        "import sys\nfrom nurbseg.app.devices.devices_command import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "sys.exit(bool({'numpy', 'cv2', 'ctypes'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60).returncode == 0


def test_the_doctor_runs_on_this_computer_and_its_json_agrees_with_its_exit_code():
    done = command("doctor", "--json")
    document = json.loads(done.stdout)
    assert set(document) == {"ready", "findings", "usb_devices", "openni2"}
    assert done.returncode == (0 if document["ready"] else 1)
    assert document["findings"], "there is a camera that is ready, or a reason why there is none"
    for finding in document["findings"]:
        assert set(finding) == {"code", "severity", "title", "reason", "steps"}


def test_cameras_are_listed_as_they_describe_themselves(virtual_cameras, capsys):
    virtual_cameras.add("one", serial="S1", vendor="ASUS")
    virtual_cameras.add("two", serial="S2", registration="absent", sync=0)
    assert devices.main([]) == 0
    text = capsys.readouterr().out
    assert text.startswith("2 cameras, through OpenNI2 2.")
    assert "640x480 at 30 (1 mm, 100 um); 320x240 at 30, 60 (1 mm, 100 um)" in text
    assert max(len(line) for line in text.splitlines()) <= 80

    assert devices.main(["list", "--json"]) == 0
    first, second = sorted(
        json.loads(capsys.readouterr().out)["cameras"], key=lambda camera: camera["serial"]
    )
    assert (first["name"], first["serial"], first["usb_id"]) == ("ASUS PS1080", "S1", "1d27:0601")
    assert (first["registration"], first["sync"], first["error"]) == (True, True, "")
    assert (second["registration"], second["sync"]) == (False, False)
    assert {"width": 640, "height": 480, "fps": 30, "pixel_format": "DEPTH_1_MM"} in first["depth_modes"]


def test_json_may_be_requested_without_naming_the_command(virtual_cameras, capsys):
    virtual_cameras.add()
    assert devices.main(["--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["cameras"]) == 1


@pytest.mark.parametrize(
    "fault",
    [
        "raise OSError('no such library')",
        "def context(): raise RuntimeError('failed to get special folder 5')",
    ],
)
def test_an_sdk_that_fails_hides_no_camera_of_another(virtual_cameras, capsys, monkeypatch, tmp_path, fault):
    virtual_cameras.add("one", serial="S1")
    (tmp_path / "pyrealsense2.py").write_text(fault)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    assert devices.main(["list"]) == 0
    printed = capsys.readouterr()
    assert "S1" in printed.out
    assert "nurbseg-devices: the RealSense SDK" in printed.err
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    with pytest.raises(DriverError, match="SDK"):
        RealSenseSource()


def test_a_camera_that_is_busy_is_listed_with_the_reason_and_is_not_ready(virtual_cameras, capsys):
    virtual_cameras.add(busy=1)
    assert devices.main(["list"]) == 1
    assert "cannot be used: opening virtual/one" in capsys.readouterr().out


def test_a_camera_without_color_cannot_be_used(virtual_cameras, capsys):
    virtual_cameras.add(color=0)
    assert devices.main(["list"]) == 1
    assert "cannot be used: it has no color stream" in capsys.readouterr().out


def test_a_camera_that_opens_but_sends_nothing_is_not_ready(virtual_cameras, monkeypatch, capsys):
    monkeypatch.setattr(camera_list, "_FIRST_IMAGE_LIMIT_S", 0.3)
    virtual_cameras.add(stalled=1)
    assert devices.main(["list"]) == 1
    assert "cannot be used: it opens, but no image arrived within 0.3 s" in capsys.readouterr().out


def test_without_a_camera_the_list_names_the_doctor(virtual_cameras, capsys):
    assert devices.main(["list"]) == 1
    assert capsys.readouterr().out == "OpenNI2 finds no camera. To find out why: nurbseg-devices doctor\n"


def test_a_driver_that_hangs_does_not_hang_the_list():
    code = (
        "import sys, time\n"
        "from nurbseg.app.devices import devices_command as devices\n"
        "from nurbseg.drivers.doctor import camera_list\n"
        "devices._TIME_LIMIT_S = 0.2\n"
        "camera_list.list_cameras = lambda: time.sleep(50)\n"
        "sys.exit(devices.main(['list']))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=45, check=False
    )
    assert done.returncode == 1
    assert "did not answer within 0.2 s" in done.stderr


def test_a_reader_that_has_enough_is_no_error(virtual_cameras):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as pipe:
        done = subprocess.run(
            [Path(sys.executable).with_name("nurbseg-devices")],
            stdout=pipe,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr == ""


def test_the_doctor_calls_a_camera_ready_that_openni2_opens(virtual_cameras, capsys):
    virtual_cameras.add(serial="S1")
    assert devices.main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("ok       Ready: PrimeSense PS1080 (1d27:0601, serial S1)")
    assert text.endswith("Result: a camera is ready to use.\n")


def test_the_doctor_for_a_kinect_does_not_call_an_xtion_ready(virtual_cameras, capsys):
    virtual_cameras.add()
    assert devices.main(["doctor", "--device", "kinect"]) == 1
    assert devices.main(["doctor", "--device", "xtion"]) == 0
    assert devices.main(["doctor", "--device", "openni2:virtual/one"]) == 0
    assert devices.main(["doctor", "--device", "virtual/two"]) == 1


def test_the_doctor_passes_on_why_a_camera_cannot_be_opened(virtual_cameras, capsys):
    virtual_cameras.add(busy=1)
    assert devices.main(["doctor", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    (finding,) = [finding for finding in document["findings"] if finding["code"] == "not-opened"]
    assert "virtual/one" in finding["reason"]


def test_a_library_that_is_not_there_is_an_error_of_one_line(tmp_path):
    done = command("list", OPENNI2_REDIST=str(tmp_path))
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("nurbseg-devices: error: OPENNI2_REDIST=")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import os; os.kill(os.getpid(), 11)", "crashed (SIGSEGV)"),
        ("import time; time.sleep(60)", "did not answer within 1 s"),
        ("print('not json')", "gave no answer"),
    ],
)
def test_a_driver_that_crashes_hangs_or_babbles_is_something_to_report(monkeypatch, tmp_path, code, words):
    stand_in = tmp_path / "python"
    stand_in.write_text(f"#!{sys.executable}\n{code}\n")
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    assert words in device_probe.probe(time_limit_s=1.0).error


def test_words_that_a_driver_prints_before_the_answer_are_passed_over(monkeypatch, tmp_path):
    stand_in = tmp_path / "python"
    stand_in.write_text(f"#!{sys.executable}\nprint('driver 1.0 loaded')\nprint('{{\"cameras\": []}}')\n")
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    answer = device_probe.probe()
    assert (answer.cameras, answer.refused, answer.error) == ((), (), "")


def test_the_doctors_text_fits_80_columns_except_for_commands_to_copy(tmp_path, monkeypatch):
    root = FakeRoot(tmp_path)
    plugged = [
        Plugged(XTION, xhci=True),
        Plugged(KINECT_CAMERA, address=6, ports=(3,), drivers=("gspca_kinect",), speed="full"),
        Plugged(KINECT_MOTOR, bus=2, address=7, ports=(4,)),
        Plugged(KINECT_MOTOR, bus=2, address=8, ports=(5,)),
    ]
    for device in plugged:
        root.plug(device)

    def refuse(path, flags):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(os, "open", refuse)
    system = describe(tmp_path, {})
    findings = diagnose(system)
    text = device_report.findings_as_text(findings, system)
    steps = {
        f"{number}. {step}" for finding in findings for number, step in enumerate(finding.steps, start=1)
    }
    lines = text.splitlines()
    assert steps <= {line.strip() for line in lines}
    # A path has no place where it could be broken.
    prose = [line for line in lines if line.strip() not in steps and str(tmp_path) not in line]
    assert max(len(line) for line in prose) <= 80
    assert lines[0].startswith("ERROR    No permission to open Xtion PRO LIVE (1d27:0601, port 1-2)")
    assert lines[-1] == "Result: no camera is ready to use."


def test_calibration_is_written_as_it_is_read(virtual_cameras, tmp_path, capsys):
    virtual_cameras.add(serial="S1")
    path = tmp_path / "camera.toml"
    assert devices.main(["calibration", str(path), "--serial", "S1"]) == 0
    calibration = read_camera_file(path).calibration()
    assert calibration.depth.fx == pytest.approx(570.3, abs=0.1)
    assert not calibration.is_registered
    output = capsys.readouterr()
    assert "570.3 pixels" in output.out
    assert output.err == ""
    before = path.read_bytes()
    assert devices.main(["calibration", str(path)]) == 1
    assert "already exists; --force" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert devices.main(["calibration", str(path), "--force"]) == 0


def test_calibration_without_a_camera_is_an_error_and_writes_nothing(virtual_cameras, tmp_path, capsys):
    assert devices.main(["calibration", str(tmp_path / "camera.toml")]) == 1
    assert "no such camera" in capsys.readouterr().err
    assert list(tmp_path.glob("*.toml")) == []


@pytest.mark.parametrize(
    "words",
    [["calibration", "camera.yaml"], ["cure"]],
)
def test_wrong_usage_ends_with_code_2(words, capsys):
    with pytest.raises(SystemExit) as ended:
        devices.main(words)
    assert ended.value.code == 2
    assert "error: argument" in capsys.readouterr().err


@pytest.mark.hardware
def test_a_real_camera_is_ready_and_described():
    assert command("doctor").returncode == 0
    cameras = json.loads(command("list", "--json").stdout)["cameras"]
    assert any(camera["usb_port"] and camera["depth_modes"] and not camera["error"] for camera in cameras)
