"""nurbseg-devices and RealSense cameras: the list and the doctor, with the real SDK's software device."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from realsense_cameras import cameras

from nurbseg.drivers.openni2.usb import UsbDevice
from nurbseg.drivers.realsense import listing
from nurbseg.drivers.realsense.listing import realsense_findings

__all__ = ["cameras"]


def devices(*words, code=0):
    command = [str(Path(sys.executable).with_name("nurbseg-devices")), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout


def test_it_is_listed_with_its_modes_and_what_is_doubtful(cameras):
    cameras.plug(usb="2.1", depth=[848, 480, 30], color=[640, 480, 30])
    cameras.plug("42")
    first, second = json.loads(devices("list", "--json"))["cameras"]
    assert (first["serial"], second["serial"]) == ("42", "935322001")
    assert first["uri"] == "realsense:42"
    assert first["error"] == ""
    assert first["doubts"] == []
    assert second["usb_speed"] == "high"
    assert second["depth_modes"][0]["width"] == 848
    # It has none of the usual mode.
    assert "no depth of 640x480@30; --depth-mode can be: 848x480@30" in second["error"]
    text = devices()
    assert "Intel RealSense D435" in text
    assert "it is connected by USB 2.1" in " ".join(text.split())


def test_the_doctor_says_that_it_is_ready_and_what_may_be_wrong(cameras):
    cameras.plug(firmware="5.1.0.0")
    document = json.loads(devices("doctor", "--device", "realsense", "--json"))
    assert document["ready"]
    assert [finding["code"] for finding in document["findings"]] == ["ready", "doubt"]
    assert "has firmware 5.1.0.0, older than 5.17.0.9" in document["findings"][1]["title"]


def test_the_doctor_says_that_there_is_none(cameras):
    document = json.loads(devices("doctor", "--device", "realsense", "--json", code=1))
    assert [finding["code"] for finding in document["findings"]] == ["not-plugged-in"]


REAL = UsbDevice(0x8086, 0x0B07, bus=2, address=7, product="Intel RealSense D435")


def test_one_that_is_plugged_in_without_the_sdk_is_named_with_what_to_install(monkeypatch):
    monkeypatch.setattr(listing.importlib.util, "find_spec", lambda name: None)
    (found,) = realsense_findings([REAL], listed=False, asked=False)
    assert (found.code, found.severity) == ("realsense-sdk-missing", "warning")
    assert "Intel RealSense D435 cannot be opened" in found.reason
    assert found.steps == ("pip install 'nurbseg[realsense]'",)


@pytest.mark.parametrize("allowed", [True, False])
def test_one_that_the_sdk_does_not_list_has_no_permission_or_is_in_use(tmp_path, allowed):
    pytest.importorskip(
        "pyrealsense2",
        reason="RealSense's SDK is missing: pip install 'nurbseg[realsense]', apt install libusb-1.0-0",
        exc_type=ImportError,
    )
    node = tmp_path / "dev/bus/usb/002/007"
    if allowed:
        node.parent.mkdir(parents=True)
        node.touch()
    (found,) = realsense_findings([REAL], listed=False, asked=True, root=tmp_path)
    assert found.code == ("not-listed" if allowed else "no-permission")
    assert found.severity == "error"
    assert allowed or 'ATTR{idVendor}=="8086"' in found.steps[0]


def test_other_devices_of_intel_are_no_cameras():
    others = [UsbDevice(0x8086, 0x8087), UsbDevice(0x1D27, 0x0B07)]
    assert list(realsense_findings(others, listed=False, asked=False)) == []
