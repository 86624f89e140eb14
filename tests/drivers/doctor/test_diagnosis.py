import errno
import os
import re

import pytest
from plugged_usb import (
    ASTRA,
    KINECT_2,
    KINECT_AUDIO,
    KINECT_CAMERA,
    KINECT_MOTOR,
    MOUSE,
    XTION,
    FakeRoot,
    Plugged,
)

from nurbseg.drivers.doctor import diagnosis
from nurbseg.drivers.doctor.diagnosis import Probe, describe, diagnose, explain_no_camera, is_ready


@pytest.fixture
def root(tmp_path):
    return FakeRoot(tmp_path)


@pytest.fixture
def findings(root):
    """Plug devices in and diagnose."""

    def run(*devices, wanted="any", environ=None, probe=None):
        for device in devices:
            root.plug(device)
        return diagnose(describe(root.path, environ or {}, probe), wanted)

    return run


@pytest.fixture
def denied(monkeypatch):
    """Have the kernel refuse to open devices, as it does to a user without permission."""

    def refuse(path, flags):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)

    monkeypatch.setattr(os, "open", refuse)


def codes(found, severity=None):
    return [each.code for each in found if severity in (None, each.severity)]


def installed(*drivers):
    return lambda root: [(root.drivers / f"lib{name}.so.0").touch() for name in drivers]


def removed(path):
    return lambda root: root.remove(path)


def ini(text):
    return lambda root: root.ini.write_text(text.format(root=root.path))


KINECT = installed("FreenectDriver")
MOTOR = Plugged(KINECT_MOTOR, address=6, ports=(1, 1))
XTION_2 = Plugged((0x0B05, 0x1234), product="Xtion 2", speed="super")
READY = Probe(cameras=("Xtion PRO LIVE",))
#: What is changed of a whole system, what is plugged in and asked; the findings' codes, and what they say.
CASES = {
    "ready": (None, [Plugged(XTION)], {"probe": READY}, ["ready"], "Ready: Xtion PRO LIVE"),
    "not asked": (None, [Plugged(XTION)], {}, [], ""),
    "nothing": (None, [Plugged(MOUSE)], {}, ["not-plugged-in"], "No depth camera is plugged in"),
    "another": (
        *(None, [Plugged(XTION)], {"wanted": "kinect"}, ["not-plugged-in"]),
        r"Xtion PRO LIVE \(1d27:0601, port 1-2\) is.*--device any",
    ),
    "webcam driver": (
        *(KINECT, [Plugged(KINECT_CAMERA, drivers=("gspca_kinect",)), MOTOR], {}, ["kernel-driver"]),
        "sudo modprobe -r gspca_kinect.*blacklist gspca_kinect",
    ),
    "sound driver": (None, [Plugged(XTION, drivers=("snd-usb-audio",))], {}, [], ""),
    "in use": (None, [Plugged(XTION, drivers=("usbfs",))], {}, ["in-use"], "lsof"),
    "no power": (KINECT, [Plugged(KINECT_MOTOR)], {}, ["kinect-no-power"], "12 V"),
    "no power for one": (
        KINECT,
        [
            Plugged(KINECT_MOTOR, address=4, ports=(1,)),
            Plugged(KINECT_CAMERA, address=5, ports=(2,)),
            Plugged(KINECT_AUDIO, address=6, ports=(3,)),
            Plugged(KINECT_MOTOR, address=7, ports=(4,)),
        ],
        {"probe": Probe(cameras=("Kinect",))},
        ["ready", "kinect-no-power"],
        "12 V",
    ),
    "USB 3": (
        *(KINECT, [Plugged(XTION, xhci=True), Plugged(KINECT_CAMERA, address=6, ports=(3,), xhci=True)], {}),
        *(["usb3-port"], "Failed to set USB interface!.*UsbInterface="),
    ),
    "slow Xtion": (None, [Plugged(XTION, speed="full")], {}, ["low-speed"], "12 Mbit/s only"),
    "slow Kinect": (
        *(installed("freenect2-openni2"), [Plugged(KINECT_2, speed="high")], {}, ["low-speed"]),
        "Kinect v2 .* runs at 480 Mbit/s only",
    ),
    "fast Kinect": (installed("freenect2-openni2"), [Plugged(KINECT_2, speed="super")], {}, [], ""),
    "no Kinect driver": (
        *(None, [Plugged(KINECT_CAMERA)], {}, ["driver-missing"]),
        "FreenectDriver in .*-DBUILD_OPENNI2_DRIVER=ON.*OpenNI2/Drivers/libFreenectDriver.so.0$",
    ),
    "no Kinect 2 driver": (
        *(
            None,
            [Plugged(KINECT_2, speed="super")],
            {},
            ["driver-missing"],
            "libfreenect2-openni2 in",
        ),
    ),
    "no Astra driver": (None, [Plugged(ASTRA)], {}, ["driver-missing"], "orbbec in .*OPENNI2_REDIST"),
    "no Xtion 2 driver": (None, [XTION_2], {}, ["driver-missing"], "SenDuck in .*libSenDuck.so"),
    "no Xtion driver": (
        *(removed("usr/lib/OpenNI2/Drivers/libPS1080.so.0"), [Plugged(XTION)], {}, ["driver-missing"]),
        "reinstall libopenni2-0",
    ),
    "no library": (
        *(removed("usr/lib/libOpenNI2.so.0"), [Plugged(XTION)], {}, ["library-missing"]),
        "apt install libopenni2-0",
    ),
    "no library there": (
        *(None, [Plugged(XTION)], {"environ": {"OPENNI2_REDIST": "/opt/openni"}}, ["library-missing"]),
        "OPENNI2_REDIST names .* in /opt/openni.*unset OPENNI2_REDIST",
    ),
    "other drivers folder": (
        *(ini("[Drivers]\nRepository={root}/usr/lib/OpenNI2/Drivers ; mine\n"), [Plugged(XTION)], {}),
        *(["drivers-folder-overridden"], r"OpenNI\.ini sends OpenNI2"),
    ),
    "no drivers folder": (
        *(ini("[Drivers]\nRepository=/nowhere\n"), [Plugged(XTION)], {}),
        *(["driver-missing", "drivers-folder-overridden"], r"PS1080 in /nowhere, in a file .* in \.so\.0\."),
    ),
    "damaged ini": (ini("no section = 1\n[[[\n"), [Plugged(XTION)], {}, [], ""),
    "one device only": (
        *(ini('[Device]\nOverride="/tmp/old.oni"\n'), [Plugged(XTION)], {}),
        *(["ini-override"], "Override=/tmp/old.oni"),
    ),
    "not listed": (None, [Plugged(XTION)], {"probe": Probe()}, ["not-listed"], "did not accept it"),
    "not opened": (
        *(None, [Plugged(XTION, xhci=True)], {"probe": Probe(refused=(("Xtion", "No, sir!"),))}),
        *(["not-opened", "usb3-port"], "lists Xtion, .* No, sir!.*USB 2"),
    ),
    "OpenNI2 crashed": (
        *(None, [Plugged(XTION)], {"probe": Probe(error="it ended with signal 11")}, ["openni2-failed"]),
        "signal 11",
    ),
    "one of two": (
        None,
        [Plugged(XTION), Plugged(KINECT_CAMERA, address=6, ports=(3,), drivers=("gspca_kinect",))],
        {"probe": READY},
        ["ready", "kernel-driver", "driver-missing"],
        "Ready: Xtion PRO LIVE",
    ),
}
#: Codes that are warnings by themselves; others are only where a camera is ready.
WARNINGS = ("usb3-port", "drivers-folder-overridden")


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_is_found_and_what_to_do_is_said(root, findings, name):
    prepare, devices, how, expected, said = CASES[name]
    if prepare is not None:
        prepare(root)
    found = findings(*devices, **how)
    assert codes(found) == expected
    assert is_ready(found) is ("ready" in expected)
    serious = [code for code in expected if code not in WARNINGS and "ready" not in expected]
    assert codes(found, "error") == serious
    text = " ".join(" ".join((each.title, each.reason, *each.steps)) for each in found)
    assert re.search(said, text), text
    assert "{" not in text


@pytest.mark.parametrize("ending", ["", "/"])
def test_the_loaders_own_folders_are_looked_through_first(root, ending):
    root.write("opt/openni/libOpenNI2.so.0", "")
    root.write("opt/openni/OpenNI2/Drivers/libPS1080.so", "")
    system = describe(root.path, {"LD_LIBRARY_PATH": f":/opt/openni{ending}"})
    assert system.installation.library == str(root.path / "opt/openni/libOpenNI2.so.0")


@pytest.fixture
def vendors_folder(tmp_path):
    folder = tmp_path / "vendor"
    drivers = folder / "OpenNI2/Drivers"
    drivers.mkdir(parents=True)
    (folder / "libOpenNI2.so.0").write_bytes(b"\x7fELF\0.so\0OpenNI.ini\0")
    (drivers / "liborbbec.so").touch()
    return folder


def test_a_vendors_library_brings_its_own_drivers_and_endings(findings, vendors_folder):
    environ = {"OPENNI2_REDIST": str(vendors_folder)}
    found = findings(Plugged(ASTRA), Plugged(XTION, address=6, ports=(3,)), environ=environ)
    # The Astra's driver is there; the Xtion's is only in the system's folder, which is not used now.
    assert codes(found) == ["driver-missing"]
    assert "PS1080" in found[0].reason


def test_a_vendors_library_reads_the_settings_next_to_it(findings, vendors_folder):
    (vendors_folder / "OpenNI.ini").write_text('[Device]\nOverride="rec.oni"\n')
    found = findings(Plugged(ASTRA), environ={"OPENNI2_REDIST": str(vendors_folder)})
    assert codes(found) == ["ini-override"]
    assert "Override=rec.oni" in found[0].reason


def test_the_explanation_never_raises(monkeypatch):
    def fail():
        raise RuntimeError("no such luck")

    monkeypatch.setattr(diagnosis, "describe", fail)
    assert "no such luck" in explain_no_camera("any")


def test_this_very_computer_can_be_described_and_explained():
    assert explain_no_camera("any")
    assert diagnose(describe()) == diagnose(describe())


def test_no_permission_prints_the_rule_and_where_it_goes(findings, denied):
    found = findings(Plugged(ASTRA), wanted="orbbec", probe=Probe())
    # It is said instead of that OpenNI2 does not list the camera.
    assert codes(found) == ["no-permission", "driver-missing"]
    rule = 'SUBSYSTEM=="usb", ATTR{idVendor}=="2bc5", ATTR{idProduct}=="0401", MODE="0666"'
    assert found[0].steps[0] == f"echo '{rule}' | sudo tee -a /etc/udev/rules.d/60-nurbseg.rules"
    assert "udevadm control --reload" in found[0].steps[1]
    assert "device-cgroup-rule" in found[0].steps[-1]


@pytest.mark.parametrize("listed", [True, False])
def test_where_there_is_no_usb_bus_container_wsl_and_virtual_machine_are_thought_of(root, findings, listed):
    if listed:
        root.plug(Plugged(XTION))
    root.remove("dev/bus/usb")
    found = findings()
    assert codes(found) == ["no-usb-bus"]
    assert ("the kernel lists Xtion PRO LIVE (1d27:0601, port 1-2)" in found[0].reason) == listed
    assert "-v /dev/bus/usb:/dev/bus/usb" in found[0].steps[0]
    assert "usbipd attach" in found[0].steps[1]


def test_a_camera_without_its_device_file_is_to_be_plugged_in_again(root, findings):
    root.plug(Plugged(XTION))
    root.remove("dev/bus/usb/001")
    (finding,) = findings()
    assert finding.code == "no-usb-node"
    assert finding.reason.startswith("/dev/bus/usb/001/005 cannot")


def test_several_faults_at_once_are_all_found_most_basic_first(root, findings, denied):
    root.remove("usr/lib/OpenNI2/Drivers/libPS1080.so.0")
    root.ini.write_text("[Drivers]\nRepository=OpenNI2/Drivers\n")
    found = findings(
        Plugged(XTION, speed="full", xhci=True),
        Plugged(KINECT_MOTOR, bus=2, ports=(3,)),
        environ={"OPENNI2_REDIST": ""},
    )
    assert codes(found, "error") == ["low-speed", "no-permission", "driver-missing", "kinect-no-power"]
    assert codes(found, "warning") == ["drivers-folder-overridden", "usb3-port"]


def test_the_explanation_is_the_main_finding_and_what_to_do_next(root, monkeypatch):
    monkeypatch.setattr(diagnosis, "describe", lambda: describe(root.path, {}))
    lines = explain_no_camera("xtion").splitlines()
    assert lines[0].startswith("No depth camera is plugged in. Looked through 0 USB devices for: Xtion")
    assert lines[1] == "  plug the camera into a USB port of this computer"
    assert lines[-1] == "To see everything that was found: nurbseg-devices doctor"
    root.plug(Plugged(XTION))
    assert "look as they should" in explain_no_camera("xtion")
