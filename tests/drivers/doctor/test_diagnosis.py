import errno

import pytest
import usb.core
from scripted_usb import (
    ASTRA,
    KINECT_2,
    KINECT_AUDIO,
    KINECT_CAMERA,
    KINECT_MOTOR,
    MOUSE,
    XTION,
    FakeRoot,
    ScriptedDevice,
    ScriptedUsb,
)

from nurbseg.drivers.doctor import diagnosis
from nurbseg.drivers.doctor.diagnosis import Probe, describe, diagnose, explain_no_camera, is_ready


@pytest.fixture
def root(tmp_path):
    return FakeRoot(tmp_path)


@pytest.fixture
def findings(root):
    """Plug devices in and diagnose; `plugged=False` leaves the file system as it is."""

    def run(*devices, wanted="any", environ=None, probe=None, plugged=True):
        if plugged:
            for device in devices:
                root.plug(device)
        system = describe(backend=ScriptedUsb(*devices), root=root.path, environ=environ or {}, probe=probe)
        return diagnose(system, wanted)

    return run


def codes(found, severity=None):
    return [each.code for each in found if severity in (None, each.severity)]


def the(found, code):
    (finding,) = [each for each in found if each.code == code]
    return finding


def test_a_camera_that_openni2_opens_is_ready(findings):
    found = findings(ScriptedDevice(XTION), probe=Probe(cameras=("Xtion PRO LIVE",)))
    assert codes(found) == ["ready"]
    assert is_ready(found)


def test_a_whole_system_without_a_probe_shows_no_fault_but_is_not_called_ready(findings):
    found = findings(ScriptedDevice(XTION))
    assert found == ()
    assert not is_ready(found)


def test_nothing_plugged_in(findings):
    finding = findings(ScriptedDevice(MOUSE))[0]
    assert (finding.code, finding.severity) == ("not-plugged-in", "error")
    assert finding.title == "No depth camera is plugged in"


def test_another_camera_than_the_requested_one(findings):
    found = findings(ScriptedDevice(XTION), wanted="kinect")
    assert codes(found) == ["not-plugged-in"]
    assert "Xtion PRO LIVE (1d27:0601, port 1-2) is" in found[0].title
    assert "--device any" in found[0].steps[0]


def test_no_permission_prints_the_rule_and_where_it_goes(findings):
    finding = findings(ScriptedDevice(ASTRA, open_errno=errno.EACCES), wanted="orbbec")[0]
    assert finding.code == "no-permission"
    rule = 'SUBSYSTEM=="usb", ATTR{idVendor}=="2bc5", ATTR{idProduct}=="0401", MODE="0666"'
    assert finding.steps[0] == f"echo '{rule}' | sudo tee -a /etc/udev/rules.d/60-nurbseg.rules"
    assert "udevadm control --reload" in finding.steps[1]


@pytest.mark.parametrize("folder", ["etc", "lib", "usr/lib", "run"])
def test_a_rule_that_is_there_but_was_not_applied(root, findings, folder):
    root.write(
        f"{folder}/udev/rules.d/60-x.rules",
        'SUBSYSTEM=="usb", ATTR{idProduct}=="0601", ATTR{idVendor}=="1d27", MODE:="0666"\n',
    )
    finding = findings(ScriptedDevice(XTION, open_errno=errno.EACCES))[0]
    assert finding.code == "no-permission"
    assert "not been applied" in finding.reason
    assert not any("echo" in step for step in finding.steps)


@pytest.mark.parametrize(
    "line",
    [
        '#SUBSYSTEM=="usb", ATTR{idVendor}=="1d27", ATTR{idProduct}=="0601", MODE="0666"',
        'ATTR{idVendor}=="1d27", ATTR{idProduct}=="0601", ENV{ID_MODEL}="Xtion"',
        'ATTR{idVendor}=="1d27", ATTR{idProduct}=="0600", MODE="0666"',
    ],
)
def test_lines_that_give_no_permission_are_no_rule_for_the_camera(root, findings, line):
    root.write("etc/udev/rules.d/60-x.rules", line + "\n")
    assert "No udev rule names it" in findings(ScriptedDevice(XTION, open_errno=errno.EACCES))[0].reason


def test_a_rule_for_all_of_a_vendors_products_counts(root, findings):
    root.write("etc/udev/rules.d/60-x.rules", 'ATTRS{idVendor}=="1d27", TAG+="uaccess"\n')
    assert "not been applied" in findings(ScriptedDevice(XTION, open_errno=errno.EACCES))[0].reason


def test_permission_in_a_container_is_given_from_outside(root, findings):
    root.write(".dockerenv", "")
    finding = findings(ScriptedDevice(XTION, open_errno=errno.EPERM))[0]
    assert finding.code == "no-permission"
    assert "device-cgroup-rule" in finding.steps[0]
    assert all("on the host" in step for step in finding.steps[1:])


@pytest.mark.parametrize(
    ("mark", "content"),
    [
        (".dockerenv", ""),
        ("run/.containerenv", ""),
        ("proc/1/cgroup", "1:name=systemd:/docker/4f5\n"),
        ("proc/1/cgroup", "0::/kubepods/besteffort/pod1\n"),
    ],
)
def test_a_container_without_usb(root, findings, mark, content):
    root.write(mark, content)
    root.remove("dev/bus/usb")
    root.remove("sys/bus")
    found = findings()
    assert codes(found) == ["no-usb-bus"]
    assert found[0].title == "This container has no USB"
    assert "-v /dev/bus/usb:/dev/bus/usb" in found[0].steps[0]


def test_a_container_without_usb_that_sees_the_hosts_camera_names_it(root, findings):
    root.write(".dockerenv", "")
    root.plug(ScriptedDevice(XTION))
    root.remove("dev/bus/usb")
    found = findings()
    assert codes(found) == ["no-usb-bus"]
    assert "Xtion PRO LIVE" in found[0].reason


def test_a_camera_plugged_in_after_the_container_was_started(root, findings):
    root.write(".dockerenv", "")
    root.plug(ScriptedDevice(XTION))
    root.remove("dev/bus/usb/001")
    found = findings(plugged=False)
    assert codes(found) == ["no-usb-node"]
    assert "after the container was started" in found[0].reason


def test_linux_inside_windows(root, findings):
    root.write("proc/version", "Linux version 5.15.90.1-microsoft-standard-WSL2")
    root.remove("dev/bus/usb")
    assert any("usbipd attach" in step for step in the(findings(), "no-usb-bus").steps)


def test_a_computer_without_a_usb_bus(root, findings):
    root.remove("dev/bus/usb")
    assert the(findings(), "no-usb-bus").title == "This computer shows no USB bus"


def test_the_webcam_driver_that_takes_a_kinect(root, findings):
    (root.drivers / "libFreenectDriver.so.0").touch()
    found = findings(
        ScriptedDevice(KINECT_CAMERA, drivers=("gspca_kinect",)),
        ScriptedDevice(KINECT_MOTOR, address=6, ports=(1, 1)),
    )
    assert codes(found) == ["kernel-driver"]
    assert found[0].steps[0] == "sudo modprobe -r gspca_kinect"
    assert "blacklist gspca_kinect" in found[0].steps[1]


def test_a_sound_driver_on_a_cameras_microphones_is_in_nobodys_way(findings):
    assert findings(ScriptedDevice(XTION, drivers=("snd-usb-audio",))) == ()


@pytest.mark.parametrize(
    "device", [ScriptedDevice(XTION, drivers=("usbfs",)), ScriptedDevice(XTION, open_errno=errno.EBUSY)]
)
def test_a_camera_that_another_program_has(findings, device):
    assert codes(findings(device)) == ["in-use"]


def test_a_kinect_without_its_power_adapter(root, findings):
    (root.drivers / "libFreenectDriver.so.0").touch()
    found = findings(ScriptedDevice(KINECT_MOTOR))
    assert codes(found) == ["kinect-no-power"]
    assert "12 V" in found[0].title


def test_of_two_kinects_the_one_without_power_is_found(root, findings):
    (root.drivers / "libFreenectDriver.so.0").touch()
    found = findings(
        ScriptedDevice(KINECT_MOTOR, address=4, ports=(1,)),
        ScriptedDevice(KINECT_CAMERA, address=5, ports=(2,)),
        ScriptedDevice(KINECT_AUDIO, address=6, ports=(3,)),
        ScriptedDevice(KINECT_MOTOR, address=7, ports=(4,)),
        probe=Probe(cameras=("Kinect",)),
    )
    assert codes(found) == ["ready", "kinect-no-power"]
    assert found[1].severity == "warning"


def test_a_usb_3_controller_is_a_warning_for_old_cameras_only(root, findings):
    (root.drivers / "libFreenectDriver.so.0").touch()
    found = findings(
        ScriptedDevice(XTION, xhci=True),
        ScriptedDevice(KINECT_CAMERA, address=6, ports=(3,), xhci=True),
    )
    assert [(each.code, each.severity) for each in found] == [("usb3-port", "warning")]
    assert "Failed to set USB interface!" in found[0].reason
    assert any("UsbInterface=" in step for step in found[0].steps)


@pytest.mark.parametrize(
    ("ids", "speed", "found_codes"),
    [
        (XTION, "full", ["low-speed"]),
        (XTION, "high", []),
        (KINECT_2, "high", ["low-speed"]),
        (KINECT_2, "super", []),
    ],
)
def test_each_camera_needs_its_speed(root, findings, ids, speed, found_codes):
    (root.drivers / "libfreenect2-openni2.so.0").touch()
    assert codes(findings(ScriptedDevice(ids, speed=speed))) == found_codes


@pytest.mark.parametrize(
    ("device", "driver", "words"),
    [
        (ScriptedDevice(KINECT_CAMERA), "FreenectDriver", "-DBUILD_OPENNI2_DRIVER=ON"),
        (ScriptedDevice(KINECT_2, speed="super"), "libfreenect2-openni2", "libfreenect2"),
        (ScriptedDevice(ASTRA), "orbbec", "OPENNI2_REDIST"),
        (ScriptedDevice((0x0B05, 0x1234), product="Xtion 2", speed="super"), "SenDuck", "libSenDuck.so"),
    ],
)
def test_a_driver_that_is_not_installed_is_named_with_how_to_get_it(root, findings, device, driver, words):
    found = findings(device)
    assert codes(found) == ["driver-missing"]
    assert driver in found[0].reason
    assert any(words in step for step in found[0].steps)
    assert not any("{" in step for step in found[0].steps)


def test_the_kinects_driver_is_to_be_copied_under_the_name_that_is_loaded(root, findings):
    steps = findings(ScriptedDevice(KINECT_CAMERA))[0].steps
    assert steps[-1].endswith(f"{root.drivers}/libFreenectDriver.so.0")


def test_a_primesense_driver_that_is_gone_comes_from_debian(root, findings):
    root.remove("usr/lib/OpenNI2/Drivers/libPS1080.so.0")
    assert "libopenni2-0" in the(findings(ScriptedDevice(XTION)), "driver-missing").steps[0]


def test_a_driver_under_a_name_that_debians_library_does_not_load(root, findings):
    (root.drivers / "libFreenectDriver.so").touch()
    finding = the(findings(ScriptedDevice(KINECT_CAMERA)), "driver-not-loadable")
    assert finding.steps == (f"sudo ln -s libFreenectDriver.so {root.drivers}/libFreenectDriver.so.0",)


def test_the_library_is_missing(root, findings):
    root.library.unlink()
    found = findings(ScriptedDevice(XTION))
    assert codes(found) == ["library-missing"]
    assert "apt install libopenni2-0" in found[0].steps[0]


@pytest.mark.parametrize("ending", ["", "/"])
def test_the_loaders_own_folders_are_looked_through_first(root, ending):
    root.write("opt/openni/libOpenNI2.so.0", "")
    root.write("opt/openni/OpenNI2/Drivers/libPS1080.so", "")
    system = describe(
        backend=ScriptedUsb(), root=root.path, environ={"LD_LIBRARY_PATH": f":/opt/openni{ending}"}
    )
    assert system.host.installation.library == str(root.path / "opt/openni/libOpenNI2.so.0")


def test_openni2_redist_names_a_folder_without_the_library(findings, tmp_path):
    found = findings(ScriptedDevice(XTION), environ={"OPENNI2_REDIST": "/opt/openni"})
    assert codes(found) == ["redist-wrong"]
    assert "OPENNI2_REDIST=/opt/openni" in found[0].reason
    assert "unset OPENNI2_REDIST" in found[0].steps[0]


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
    found = findings(ScriptedDevice(ASTRA), ScriptedDevice(XTION, address=6, ports=(3,)), environ=environ)
    # The Astra's driver is there; the Xtion's is only in the system's folder, which is not used now.
    assert sorted(codes(found)) == ["driver-missing", "redist-set"]
    assert "PS1080" in the(found, "driver-missing").reason
    assert the(found, "redist-set").severity == "note"


def test_a_vendors_library_reads_the_settings_next_to_it(findings, vendors_folder):
    (vendors_folder / "OpenNI.ini").write_text('[Device]\nOverride="rec.oni"\n')
    found = findings(ScriptedDevice(ASTRA), environ={"OPENNI2_REDIST": str(vendors_folder)})
    assert "Override=rec.oni" in the(found, "ini-override").reason


def test_openni_ini_sends_openni2_to_another_drivers_folder(root, findings):
    (root.path / "mydrivers").mkdir()
    (root.path / "mydrivers/libPS1080.so.0").touch()
    root.ini.write_text(f"[Drivers]\nRepository={root.path}/mydrivers ; mine\n")
    found = findings(ScriptedDevice(XTION))
    assert [(each.code, each.severity) for each in found] == [("drivers-folder-overridden", "warning")]
    assert str(root.ini) in found[0].title


def test_openni_ini_names_a_drivers_folder_that_is_not_there(root, findings):
    root.ini.write_text("[Drivers]\nRepository=/nowhere\n")
    found = findings(ScriptedDevice(XTION))
    assert codes(found) == ["drivers-folder-empty", "drivers-folder-overridden"]
    assert "Repository=" in found[0].steps[0]


def test_a_damaged_openni_ini_is_taken_for_empty(root, findings):
    root.ini.write_text("no section = 1\n[[[\n")
    assert findings(ScriptedDevice(XTION)) == ()


def test_openni_ini_overrides_the_device(root, findings):
    root.ini.write_text('[Device]\nOverride="/tmp/old.oni"\n')
    finding = findings(ScriptedDevice(XTION))[0]
    assert (finding.code, finding.severity) == ("ini-override", "error")


def test_the_drivers_folder_is_gone(root, findings):
    root.remove("usr/lib/OpenNI2/Drivers")
    found = findings(ScriptedDevice(XTION))
    assert codes(found) == ["drivers-folder-empty"]
    assert "reinstall libopenni2-0" in found[0].steps[0]


def test_libusb_is_missing(root, monkeypatch):
    def no_backend(**_):
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", no_backend)
    root.plug(ScriptedDevice(XTION))
    found = diagnose(describe(root=root.path, environ={}))
    # The kernel's list and the device file still tell that the camera is there and may be opened.
    assert [(each.code, each.severity) for each in found] == [("libusb-missing", "warning")]
    root.remove("sys")
    found = diagnose(describe(root=root.path, environ={}))
    assert [(each.code, each.severity) for each in found] == [("libusb-missing", "error")]
    assert found[0].steps == ("sudo apt install libusb-1.0-0",)


def test_usb_that_cannot_be_searched_is_reported(root):
    backend = ScriptedUsb(enumerate_error=usb.core.USBError("Input/output error", -1, errno.EIO))
    found = diagnose(describe(backend=backend, root=root.path, environ={}))
    assert codes(found) == ["usb-scan-failed"]


def test_a_camera_that_does_not_answer(findings):
    assert codes(findings(ScriptedDevice(XTION, transfer_errno=errno.ETIMEDOUT))) == ["not-answering"]


def test_openni2_does_not_list_a_camera_that_nothing_speaks_against(findings):
    assert codes(findings(ScriptedDevice(XTION), probe=Probe())) == ["not-listed"]


def test_what_keeps_the_camera_away_is_said_instead_of_that_it_is_not_listed(findings):
    found = findings(ScriptedDevice(XTION, open_errno=errno.EACCES), probe=Probe())
    assert codes(found) == ["no-permission"]


def test_openni2s_words_for_refusing_to_open_are_passed_on(findings):
    probe = Probe(refused=(("Xtion PRO LIVE", "Failed to set USB interface!"),))
    found = findings(ScriptedDevice(XTION, xhci=True), probe=probe)
    assert codes(found) == ["not-opened", "usb3-port"]
    assert found[0].reason == "Failed to set USB interface!"
    assert "USB 2" in found[0].steps[0]


def test_a_probe_that_failed_is_an_error_of_its_own(findings):
    found = findings(ScriptedDevice(XTION), probe=Probe(error="it ended with signal 11"))
    assert codes(found) == ["openni2-failed"]
    assert "signal 11" in found[0].reason


def test_several_faults_at_once_are_all_found_most_basic_first(root, findings):
    root.remove("usr/lib/OpenNI2/Drivers/libPS1080.so.0")
    root.ini.write_text("[Drivers]\nRepository=OpenNI2/Drivers\n")
    found = findings(
        ScriptedDevice(XTION, speed="full", open_errno=errno.EACCES, xhci=True),
        ScriptedDevice(KINECT_MOTOR, bus=2, ports=(3,)),
        environ={"OPENNI2_REDIST": ""},
    )
    assert codes(found, "error") == ["low-speed", "no-permission", "driver-missing", "kinect-no-power"]
    assert codes(found, "warning") == ["drivers-folder-overridden", "usb3-port"]


def test_where_one_camera_is_ready_another_ones_faults_are_warnings(root, findings):
    found = findings(
        ScriptedDevice(XTION),
        ScriptedDevice(KINECT_CAMERA, address=6, ports=(3,), drivers=("gspca_kinect",)),
        probe=Probe(cameras=("Xtion PRO LIVE",)),
    )
    assert codes(found) == ["ready", "kernel-driver", "driver-missing"]
    assert codes(found, "error") == []


@pytest.fixture
def this_computer(monkeypatch):
    """Have `explain_no_camera` look at a computer of the test's."""

    def use(*devices, root, environ=None):
        system = describe(backend=ScriptedUsb(*devices), root=root.path, environ=environ or {})
        monkeypatch.setattr(diagnosis, "describe", lambda: system)

    return use


def test_the_explanation_is_the_main_finding_and_what_to_do_next(root, this_computer):
    this_computer(root=root)
    lines = explain_no_camera("xtion").splitlines()
    assert lines[0].startswith("No depth camera is plugged in. Looked through 0 USB devices for: Xtion")
    assert lines[1] == "  plug the camera into a USB port of this computer"
    assert lines[-1] == "To see everything that was found: nurbseg-devices doctor"


def test_where_nothing_is_wrong_the_explanation_names_the_doctor(root, this_computer):
    root.plug(ScriptedDevice(XTION))
    this_computer(ScriptedDevice(XTION), root=root)
    assert "nurbseg-devices doctor" in explain_no_camera("xtion")


def test_the_explanation_never_raises(monkeypatch):
    def fail():
        raise RuntimeError("no such luck")

    monkeypatch.setattr(diagnosis, "describe", fail)
    assert "no such luck" in explain_no_camera("any")


def test_this_very_computer_can_be_described_and_explained():
    assert explain_no_camera("any")
    assert diagnose(describe()) == diagnose(describe())


def test_code_that_is_compiled_in_every_run_is_a_warning(findings, monkeypatch):
    monkeypatch.setattr(diagnosis, "cache_error", lambda: "/c: other users can write it")
    finding = the(findings(ScriptedDevice(MOUSE)), "code-not-kept")
    assert finding.severity == "warning"
    assert finding.reason.endswith("/c: other users can write it")
    assert "XDG_CACHE_HOME" in finding.steps[0]
