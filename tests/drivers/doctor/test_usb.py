import errno
import os

import pytest
from plugged_usb import ASTRA, KINECT_2, KINECT_CAMERA, MOUSE, XTION, FakeRoot, Plugged

from nurbseg.drivers.openni2.usb import camera_parts, read_usb, try_to_open
from nurbseg.drivers.openni2.usb_ids import families, identify


@pytest.fixture
def root(tmp_path):
    return FakeRoot(tmp_path)


def test_a_device_is_described_by_the_kernels_list(root):
    root.plug(
        Plugged(XTION, bus=3, address=7, ports=(1, 4), product="Xtion PRO LIVE", serial="A1", xhci=True)
    )
    (device,) = read_usb(root.path)
    assert (device.ids, device.port, device.speed) == ("1d27:0601", "3-1.4", "high")
    assert (device.bus, device.address) == (3, 7)
    assert (device.product, device.serial) == ("Xtion PRO LIVE", "A1")
    assert device.usb3_controller


@pytest.mark.parametrize(
    ("refusal", "access"),
    [(errno.EACCES, "denied"), (errno.EPERM, "denied"), (errno.ENODEV, "no-node"), (0, "open")],
)
def test_whether_a_device_can_be_opened_is_found_by_opening_its_file(root, monkeypatch, refusal, access):
    root.plug(Plugged(XTION))
    (device,) = read_usb(root.path)
    descriptors, really_open = [], os.open

    def opened(path, flags):
        assert path == root.path / "dev/bus/usb/001/005"
        assert flags & os.O_RDWR
        if refusal:
            raise OSError(refusal, os.strerror(refusal))
        descriptors.append(really_open(path, flags))
        return descriptors[-1]

    monkeypatch.setattr(os, "open", opened)
    assert try_to_open(device, root.path) == access
    for descriptor in descriptors:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(descriptor)


def test_a_camera_whose_device_file_is_not_here_is_reported(root):
    root.plug(Plugged(XTION))
    root.remove("dev/bus/usb/001")
    (part,) = camera_parts(read_usb(root.path), root.path)
    assert part.access == "no-node"


def test_devices_that_are_no_cameras_are_listed_but_left_alone(root, monkeypatch):
    root.plug(Plugged(MOUSE))
    monkeypatch.setattr(os, "open", lambda *_: pytest.fail("opened"))
    (device,) = devices = read_usb(root.path)
    assert device.ids == "046d:c077"
    assert camera_parts(devices, root.path) == ()


def test_hubs_are_left_out(root):
    root.plug(Plugged((0x05E3, 0x0610), drivers=("hub",)))
    assert read_usb(root.path) == ()


def test_kernel_drivers_are_those_of_the_devices_own_interfaces(root):
    root.plug(Plugged(KINECT_CAMERA, ports=(2,), drivers=("gspca_kinect",)))
    root.plug(Plugged(MOUSE, address=9, ports=(2, 1), drivers=("usbhid",)))
    assert {device.ids: device.drivers for device in read_usb(root.path)} == {
        "045e:02ae": ("gspca_kinect",),
        "046d:c077": ("usbhid",),
    }


def test_half_an_entry_of_a_device_that_is_just_leaving_is_passed_over(root):
    root.plug(Plugged(XTION))
    root.remove("sys/bus/usb/devices/1-2/idVendor")
    assert read_usb(root.path) == ()


def test_without_the_kernels_list_no_device_is_found(tmp_path):
    assert read_usb(tmp_path) == ()


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
