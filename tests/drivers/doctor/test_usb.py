import errno

import pytest
import usb.core
from scripted_usb import ASTRA, KINECT_2, KINECT_CAMERA, MOUSE, XTION, FakeRoot, ScriptedDevice, ScriptedUsb

from nurbseg.common.errors import BackendMissingError
from nurbseg.drivers.doctor.usb import find_devices, read_sysfs, scan_usb
from nurbseg.drivers.openni2.usb_ids import families, identify


@pytest.fixture
def root(tmp_path):
    return FakeRoot(tmp_path)


def scan(root, *devices, **options):
    return scan_usb(ScriptedUsb(*devices), root.path, **options)


def test_a_camera_is_described_by_the_kernels_list_and_tried_by_pyusb(root):
    xtion = ScriptedDevice(
        XTION, bus=3, address=7, ports=(1, 4), product="Xtion PRO LIVE", serial="A1", xhci=True
    )
    root.plug(xtion)
    (device,) = scan(root, xtion).devices
    assert (device.ids, device.port, device.speed) == ("1d27:0601", "3-1.4", "high")
    assert (device.product, device.serial, device.access) == ("Xtion PRO LIVE", "A1", "open")
    assert device.usb3_controller
    assert not xtion.is_open


def test_without_the_kernels_list_pyusb_alone_reads_names_port_and_speed(root):
    root.remove("sys")
    xtion = ScriptedDevice(XTION, product="PrimeSense Device", serial="B2", speed="super")
    scanned = scan(root, xtion)
    (device,) = scanned.devices
    assert not scanned.sysfs
    assert (device.port, device.speed, device.product, device.serial) == (
        "1-2",
        "super",
        "PrimeSense Device",
        "B2",
    )
    assert not xtion.is_open


@pytest.mark.parametrize(
    ("refusal", "access"),
    [
        (errno.EACCES, "denied"),
        (errno.EPERM, "denied"),
        (errno.EBUSY, "busy"),
        (errno.ENODEV, "no-node"),
        (errno.ETIMEDOUT, "silent"),
        (errno.EOVERFLOW, "silent"),
    ],
)
def test_why_a_device_cannot_be_opened_is_reported_by_the_systems_error(root, refusal, access):
    (device,) = scan(root, ScriptedDevice(XTION, open_errno=refusal)).devices
    assert device.access == access


def test_a_device_that_opens_but_does_not_answer_is_silent_and_closed_again(root):
    xtion = ScriptedDevice(XTION, transfer_errno=errno.ETIMEDOUT, product="Xtion", serial="1")
    (device,) = scan(root, xtion).devices
    assert device.access == "silent"
    assert not xtion.is_open


def test_each_request_has_a_short_time_limit(root):
    xtion = ScriptedDevice(XTION, product="Xtion", serial="1")
    root.remove("sys")
    scan(root, xtion)
    assert xtion.transfers
    assert all(timeout <= 300 for *_, timeout in xtion.transfers)


def test_devices_that_are_no_cameras_are_listed_but_left_alone(root):
    mouse = ScriptedDevice(MOUSE, open_errno=errno.EACCES)
    (device,) = scan(root, mouse).devices
    assert device.access == "unknown"
    assert device.model is None


def test_an_asus_device_is_tried_only_while_its_name_is_not_known(root):
    keyboard = ScriptedDevice((0x0B05, 0x1234), product="USB keyboard", serial="1")
    root.plug(keyboard)
    assert scan(root, keyboard).devices[0].access == "unknown"
    assert not keyboard.transfers
    root.remove("sys")
    assert scan(root, keyboard).devices[0].product == "USB keyboard"


def test_hubs_are_left_out(root):
    root.plug(ScriptedDevice((0x05E3, 0x0610), drivers=("hub",), device_class=9))
    assert scan(root, ScriptedDevice((0x05E3, 0x0610), device_class=9)).devices == ()


def test_after_the_time_budget_no_further_device_is_tried(root):
    first, second = ScriptedDevice(XTION, address=5), ScriptedDevice(XTION, address=6)
    root.plug(first)
    root.plug(ScriptedDevice(XTION, address=6, ports=(3,)))
    moments = iter([0.0, 1.0, 5.0])
    scanned = scan(root, first, second, budget_s=2.0, clock=lambda: next(moments))
    assert len(first.transfers) == 1
    assert second.transfers == []
    # Its device file still tells that it could be opened.
    assert [device.access for device in scanned.devices] == ["open", "unknown"]


def test_without_libusb_the_kernels_list_still_shows_what_is_plugged_in(root, monkeypatch):
    def no_backend(**_):
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", no_backend)
    root.plug(ScriptedDevice(XTION))
    scanned = scan_usb(None, root.path)
    assert not scanned.libusb
    assert [device.ids for device in scanned.devices] == ["1d27:0601"]
    with pytest.raises(BackendMissingError, match=r"apt install libusb-1\.0-0"):
        find_devices()


def test_whatever_pyusb_raises_is_reported_with_what_the_kernel_lists(root):
    root.plug(ScriptedDevice(XTION))
    backend = ScriptedUsb(enumerate_error=usb.core.USBError("Input/output error", -1, errno.EIO))
    scanned = scan_usb(backend, root.path)
    assert "Input/output error" in scanned.problem
    assert [device.ids for device in scanned.devices] == ["1d27:0601"]


def test_a_camera_whose_device_file_is_not_here_is_reported_without_pyusb(root):
    root.plug(ScriptedDevice(XTION))
    root.remove("dev/bus/usb/001")
    (device,) = scan(root).devices
    assert device.access == "no-node"


def test_kernel_drivers_are_those_of_the_devices_own_interfaces(root):
    root.plug(ScriptedDevice(KINECT_CAMERA, ports=(2,), drivers=("gspca_kinect",)))
    root.plug(ScriptedDevice(MOUSE, address=9, ports=(2, 1), drivers=("usbhid",)))
    assert {device.ids: device.drivers for device in read_sysfs(root.path)} == {
        "045e:02ae": ("gspca_kinect",),
        "046d:c077": ("usbhid",),
    }


def test_half_an_entry_of_a_device_that_is_just_leaving_is_passed_over(root):
    root.plug(ScriptedDevice(XTION))
    root.remove("sys/bus/usb/devices/1-2/idVendor")
    assert read_sysfs(root.path) == ()


def test_no_kernel_list_is_no_error(tmp_path):
    assert read_sysfs(tmp_path / "nothing") == ()


@pytest.mark.parametrize(
    ("ids", "family", "role"),
    [
        (XTION, "ps1080", "camera"),
        ((0x1D27, 0x1290), "pslink", "camera"),
        ((0x1D27, 0xF9DB), "pslink", "camera"),
        (KINECT_CAMERA, "kinect1", "camera"),
        ((0x045E, 0x02BB), "kinect1", "audio"),
        ((0x045E, 0x02C2), "kinect1", "motor"),
        (KINECT_2, "kinect2", "camera"),
        (ASTRA, "orbbec", "camera"),
        ((0x2BC5, 0x0614), "orbbec", "camera"),
    ],
)
def test_ids_name_the_camera_or_its_part(ids, family, role):
    model = identify(*ids)
    assert model is not None
    assert (model.family.key, model.role) == (family, role)


def test_an_astras_webcam_half_is_not_taken_for_the_depth_camera():
    assert identify(0x2BC5, 0x0501) is None


def test_an_xtion_2_is_known_by_its_name_only():
    model = identify(0x0B05, 0x1234, "ASUS Xtion 2")
    assert model is not None and model.family.key == "xtion2"
    assert identify(0x0B05, 0x1234, "ASUS USB keyboard") is None


def test_words_of_the_device_flag_name_families():
    assert {family.key for family in families("kinect")} == {"kinect1", "kinect2"}
    assert {family.key for family in families("openni2:xtion")} == {"ps1080", "pslink", "xtion2"}
    assert families("1d27/0601@1/5") == families("any")
